// From radiance to the screen: cells side by side, a wipe, a difference.
const TONES = ["clipped", "reinhard", "filmic"];
const BACKGROUND = [0.016, 0.018, 0.021];

class Display {
  constructor(device, shaders) {
    this.device = device;
    this.program = device.program(shaders.screen, shaders.display);
    this.adding = device.program(shaders.screen, shaders.add);
    this.bytes = device.target(PLOT, PLOT, device.gl.RGBA8, { depth: false });
  }

  // Draw a source {picture, part, weight} into a rectangle (from the bottom left), clipped to another.
  draw(view, [x, y, width, height], clip, a, b = null) {
    const { device } = this, { gl } = device;
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...clip);
    gl.viewport(x, y, width, height);
    device.use(this.program, {
      picture_a: a.picture,
      picture_b: (b ?? a).picture,
      cell_origin: [x, y],
      cell_size: [width, height],
      picture_part: a.part,
      weight: a.weight,
      exposure: device.floats ? view.exposure : 1,
      tone: TONES.indexOf(view.tone),
      difference: b ? 1 : 0,
      gain: view.gain,
      background: BACKGROUND,
    });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
  }

  // All of the canvas; source(material) is what is there of its picture.
  present(view, cells, source) {
    const { gl } = this.device, { width, height } = gl.canvas;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...BACKGROUND.map((x) => 12.92 * Math.min(x, 0.003)), 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    for (const { area, materials } of cells) {
      const [a, b] = materials.map(source);
      if (view.mode === "difference") this.draw(view, area, area, a, b);
      else if (view.mode === "wipe") {
        const [x, y, w, h] = area, at = Math.round(view.split * w);
        if (at > 0) this.draw(view, area, [x, y, at, h], a);
        if (at < w) this.draw(view, area, [x + at, y, w - at, h], b);
      } else this.draw(view, area, area, a);
    }
  }

  // Add a picture to a sum.
  add(picture, total, first) {
    const { device } = this, { gl } = device;
    gl.bindFramebuffer(gl.FRAMEBUFFER, total.frame);
    gl.viewport(0, 0, total.width, total.height);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.SCISSOR_TEST);
    if (first) {
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
    }
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    device.use(this.adding, { picture_a: picture });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.BLEND);
  }

  // A plot as the screen shows pictures, for a canvas of two dimensions; rows from the top.
  plotted(view, plot) {
    const { gl } = this.device, image = new ImageData(PLOT, PLOT), row = 4 * PLOT, area = [0, 0, PLOT, PLOT];
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.bytes.frame);
    // B · π, as a light of 0 EV shows it.
    const lit = { ...view, exposure: Math.PI * view.exposure };
    this.draw(lit, area, area, { picture: plot, part: [1, 1], weight: 1 });
    const found = new Uint8Array(row * PLOT);
    gl.readPixels(0, 0, PLOT, PLOT, gl.RGBA, gl.UNSIGNED_BYTE, found);
    for (let y = 0; y < PLOT; y++) image.data.set(found.subarray(y * row, (y + 1) * row), (PLOT - 1 - y) * row);
    return image;
  }
}

// Pictures of a shape with a material: the shaders of the real-time renderer, of which each material has its own.
const PLOT = 128; // pixels of a hemisphere's plot

class Renderer {
  constructor(device, data, view) {
    Object.assign(this, { device, data, view });
    this.materials = [];
    this.shapes = new Map();
    this.tables = new Map(); // unpacked once: a lost context does not lose them
    this.points = device.program(data.shaders.mesh, data.shaders.point);
    this.lights = device.table(new Float32Array(24), "float32");
    this.plot = device.target(PLOT, PLOT, device.exact, { depth: false });
  }

  async table(packed) {
    if (!this.tables.has(packed.blob)) this.tables.set(packed.blob, await unpacked(packed));
    return this.device.table(this.tables.get(packed.blob), packed.type);
  }

  async load() {
    for (const { shaders, textures, texels } of this.data.materials) {
      const values = { lod_texels: [texels[1], texels[0]] };
      for (const texture of textures) values[texture.name] = await this.table(texture);
      const mesh = this.device.program(shaders.vertex, shaders.fragment);
      this.materials.push({ mesh, plot: null, plotText: shaders.hemisphere, values });
    }
    for (const shape of this.data.shapes)
      this.shapes.set(shape.name, { triangles: await this.table(shape.triangles), count: shape.count });
  }

  // What all programs that draw the shape read.
  surface(target, width, height, offset, share) {
    const { view, device } = this, { gl } = device, { triangles, count } = this.shapes.get(view.shape.name);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LESS);
    const [x] = view.camera.tangents(width, height);
    return {
      count,
      values: {
        ...view.camera.uniforms(width, height, offset),
        triangles,
        uv_row0: [view.tiling, 0, 0],
        uv_row1: [0, view.tiling, 0],
        uv_turn: [1, 0, 1],
        lod_angle: (share * 2 * x) / width,
        lod_unit: 0,
        lod_bias: 0,
      },
    };
  }

  clip(area) {
    const { gl } = this.device;
    if (area) {
      gl.enable(gl.SCISSOR_TEST);
      gl.scissor(...area);
    } else gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  // Radiance of a material, or of an area (x, y, width, height from the bottom left) of the picture.
  draw(index, target, { width, height, offset = [0.5, 0.5], share = 1, area = null }) {
    const { device, view } = this, { gl } = device, material = this.materials[index];
    const { count, values } = this.surface(target, width, height, offset, share);
    this.clip(area);
    gl.bindTexture(this.lights.target, this.lights.texture);
    gl.texSubImage3D(this.lights.target, 0, 0, 0, 0, 6, 1, 1, gl.RGBA, gl.FLOAT, lightTable(view.lights));
    device.use(material.mesh, {
      ...values,
      ...material.values,
      scene_lights: this.lights,
      light_first: 0,
      light_end: view.lights.filter((light) => light.on).length,
      // Bytes end at 1: there the exposure comes first.
      scale: device.floats ? 1 : view.exposure,
      two_sided: 1,
      emission: [0, 0, 0],
      pass: 0,
    });
    gl.drawArrays(gl.TRIANGLES, 0, 3 * count);
  }

  // What is at a pixel, from the top left: coordinates, level of detail, rows of the local frame, place; null beside the shape.
  point(index, target, width, height, x, y) {
    const { device, view } = this, { gl } = device, found = [], area = [x, height - 1 - y, 1, 1];
    const { lod_texels } = this.materials[index].values;
    for (let wanted = 0; wanted < 5; wanted++) {
      const { count, values } = this.surface(target, width, height, [0.5, 0.5], 1);
      this.clip(area);
      device.use(this.points, { ...values, lod_texels, wanted });
      gl.drawArrays(gl.TRIANGLES, 0, 3 * count);
      found.push(device.pixel(area[0], area[1]));
    }
    gl.disable(gl.SCISSOR_TEST);
    if (found[0][3] === 0) return null;
    const [[u, v, lod], ...rest] = found, frame = rest.slice(0, 3).map((row) => [...row.slice(0, 3)]);
    const place = [...rest[3].slice(0, 3)];
    return { uv: [u, v], lod, frame, place, shape: view.shape.name };
  }

  // B over the hemisphere of lights, or of views, into `plot`.
  hemisphere(index, { uv, lod, fixed, lights }) {
    const { device } = this, { gl } = device, material = this.materials[index];
    material.plot ??= device.program(this.data.shaders.screen, material.plotText);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.plot.frame);
    gl.viewport(0, 0, PLOT, PLOT);
    gl.disable(gl.BLEND);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.SCISSOR_TEST);
    device.use(material.plot, {
      ...material.values, plot_uv: uv, plot_lod: lod, plot_fixed: fixed, plot_lights: lights ? 1 : 0, plot_size: [PLOT, PLOT],
    });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    return device.pixels(0, 0, PLOT, PLOT);
  }
}

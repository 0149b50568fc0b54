// The texel that was clicked: where it is, its radiance, its apparent BRDF over lights and over views.
class Texel {
  constructor(renderer, display, view, data, root) {
    Object.assign(this, { renderer, display, view, data, root });
    this.at = null;
    this.plots = []; // {canvas, values, material, lights}
    root.addEventListener("pointermove", (event) => this.read(event));
    root.addEventListener("pointerdown", (event) => this.read(event));
  }

  set({ at, radiance }, materials) {
    Object.assign(this, { at, radiance, materials });
    this.tiling = this.view.tiling;
    this.build();
  }

  forget() {
    this.at = null;
    this.build();
  }

  // The same place of the shape is another one of the texture.
  retiled() {
    if (!this.at) return;
    this.at.uv = this.at.uv.map((x) => (x * this.view.tiling) / this.tiling);
    this.tiling = this.view.tiling;
  }

  // Directions in the local frame, mirrored at the surface where it is seen from behind.
  directions() {
    const { at, view } = this, local = (w) => at.frame.map((row) => dot(row, w));
    const w_view = local(unit(sum(view.camera.origin, scaled(at.place, -1))));
    const side = w_view[2] < 0 ? -1 : 1, turned = ([x, y, z]) => [x, y, side * z];
    return {
      w_view: turned(w_view),
      w_lights: view.lights.map((light) => turned(local(direction(light.azimuth, light.elevation)))),
    };
  }

  build() {
    this.root.replaceChildren();
    this.plots = [];
    this.root.parentElement.hidden = !this.at;
    if (!this.at) return;
    this.text = document.createElement("p");
    this.reading = document.createElement("p");
    this.reading.className = "muted reading";
    this.root.append(this.text);
    for (const material of this.materials) {
      const row = document.createElement("div");
      row.className = "plots";
      const name = document.createElement("h4");
      name.textContent = this.data.materials[material].name;
      row.append(name);
      for (const lights of [true, false]) {
        const figure = document.createElement("figure"), canvas = document.createElement("canvas");
        canvas.width = canvas.height = PLOT;
        const caption = document.createElement("figcaption");
        caption.textContent = lights ? "all lights, this view" : "all views, light 1";
        canvas.setAttribute("role", "img");
        canvas.setAttribute("aria-label", `${name.textContent}: apparent BRDF, ${caption.textContent}`);
        figure.append(canvas, caption);
        row.append(figure);
        this.plots.push({ canvas, material, lights, values: null });
      }
      this.root.append(row);
    }
    this.root.append(this.reading);
    this.draw();
  }

  draw() {
    if (!this.at) return;
    const { uv, lod } = this.at, { w_view, w_lights } = this.directions();
    for (const plot of this.plots) {
      const fixed = plot.lights ? w_view : w_lights[0];
      plot.values = this.renderer.hemisphere(plot.material, { uv, lod, fixed, lights: plot.lights });
      const image = this.display.plotted(this.view, this.renderer.plot), context = plot.canvas.getContext("2d");
      context.putImageData(image, 0, 0);
      const shown = plot.lights ? w_lights.filter((_, i) => this.view.lights[i].on) : [w_view];
      for (const w of shown) this.mark(context, w);
    }
    this.text.replaceChildren(...this.lines(w_view, w_lights).map((line) => {
      const part = document.createElement("span");
      part.textContent = line;
      return part;
    }));
  }

  mark(context, w) {
    if (w[2] <= 0) return;
    const across = Math.hypot(w[0], w[1]), radius = Math.acos(clamp(w[2], -1, 1)) / (Math.PI / 2) / Math.max(across, 1e-9);
    const x = (0.5 + 0.5 * radius * w[0]) * PLOT, y = (0.5 - 0.5 * radius * w[1]) * PLOT;
    for (const [colour, width] of [["#000", 3], ["#fff", 1.2]]) {
      Object.assign(context, { strokeStyle: colour, lineWidth: width });
      context.beginPath();
      context.arc(x, y, 4, 0, 2 * Math.PI);
      context.stroke();
    }
  }

  lines(w_view, w_lights) {
    const [rows, columns] = this.data.materials[this.materials[0]].texels;
    const index = (x, n) => Math.floor((x - Math.floor(x)) * n), [u, v] = this.at.uv;
    const polar = (w) => `${(Math.acos(clamp(w[2], -1, 1)) / RADIANS).toFixed(1)}°, ${(Math.atan2(w[1], w[0]) / RADIANS).toFixed(1)}°`;
    const lines = [
      `row ${index(v, rows)}, column ${index(u, columns)}`,
      `uv ${u.toFixed(4)}, ${v.toFixed(4)}`,
      `view θ, φ ${polar(w_view)}`,
      ...w_lights.flatMap((w, i) => (this.view.lights[i].on ? [`light ${i + 1} θ, φ ${polar(w)}`] : [])),
    ];
    for (const [i, material] of this.materials.entries())
      lines.push(`radiance ${this.materials.length > 1 ? `${this.data.materials[material].name} ` : ""}${threeOf(this.radiance[i])}`);
    return lines;
  }

  read(event) {
    const plot = this.plots.find(({ canvas }) => canvas === event.target);
    if (!plot?.values) return;
    const box = plot.canvas.getBoundingClientRect();
    const x = (event.clientX - box.left) / box.width, y = (event.clientY - box.top) / box.height;
    const across = [2 * x - 1, 1 - 2 * y], radius = Math.hypot(...across);
    if (radius >= 1) return;
    const at = 4 * ((PLOT - 1 - Math.floor(y * PLOT)) * PLOT + Math.floor(x * PLOT));
    this.reading.textContent = `${plot.lights ? "light" : "view"} θ ${(90 * radius).toFixed(0)}°, ` +
      `φ ${(Math.atan2(across[1], across[0]) / RADIANS).toFixed(0)}°: B ${threeOf(plot.values.subarray(at, at + 3))} 1/sr`;
  }
}

const threeOf = (values) => [...values].slice(0, 3).map((x) => x.toPrecision(3)).join(" ");

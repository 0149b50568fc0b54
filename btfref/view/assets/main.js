// The page: what is seen, and what changes it.
const MODES = ["one", "side", "wipe", "difference"];

function firstView(data) {
  const count = data.materials.length, [shape] = data.shapes;
  return {
    count, shape, a: 0, b: Math.min(1, count - 1), mode: count > 1 ? "side" : "one", split: 0.5, held: "camera",
    stops: 0, tone: TONES[0], gain: 4, tiling: shape.tiling, samples: 4,
    lights: TWO_LIGHTS.map((light) => ({ ...light })), camera: new Camera(shape),
    get exposure() { return 2 ** this.stops; },
  };
}

class Page {
  constructor(data) {
    this.data = data;
    this.canvas = document.getElementById("picture");
    this.view = firstView(data);
    this.panel = new Panel(data, this.view, this.actions());
    this.pointer = new Pointer(this.canvas, this.view, this.act);
    this.panel.refresh();
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault(); // asks for another one
      if (this.painter) this.painter.stopped = true;
      document.documentElement.dataset.lost = "yes";
      complain("The graphics device was lost. The page goes on as soon as the browser gives it back; if it does not, reload the page.");
    });
    this.canvas.addEventListener("webglcontextrestored", () => this.start().catch(failed));
  }

  async start() {
    const { data, view, canvas } = this;
    this.device = new Device(canvas);
    const tables = this.renderer?.tables;
    this.renderer = new Renderer(this.device, data, view);
    if (tables) this.renderer.tables = tables;
    await this.renderer.load();
    this.display = new Display(this.device, data.shaders);
    this.painter = new Painter(this.device, this.renderer, this.display, view);
    this.painter.heard.push((stage) => this.heard(stage));
    const at = this.texel?.at;
    this.texel = new Texel(this.renderer, this.display, view, data, document.getElementById("texel"));
    if (at) this.texel.forget();
    complain("");
    delete document.documentElement.dataset.lost;
    this.resize();
    this.painter.changed();
  }

  resize() {
    if (!this.painter || this.painter.stopped) return;
    // More pixels than 2 for each of CSS are not seen.
    const ratio = Math.min(devicePixelRatio, 2), { canvas } = this;
    const width = Math.max(Math.round(canvas.clientWidth * ratio), 1), height = Math.max(Math.round(canvas.clientHeight * ratio), 1);
    if (canvas.width === width && canvas.height === height) return;
    Object.assign(canvas, { width, height });
    this.changed();
  }

  heard(stage) {
    const { device, painter, data } = this, [width, height] = painter.size;
    this.panel.overlay(painter.cells, this.texel.at);
    // Plots cost what their pixels do: with a slow renderer they wait for the rest.
    const cost = Math.max(...painter.shown.map((index) => painter.costs[index]));
    if (stage !== "rough" || cost * 2 * PLOT * PLOT * this.texel.plots.length < BUDGET) this.texel.draw();
    const kept = { [device.gl.RGBA32F]: "32-bit floats", [device.gl.RGBA16F]: "16-bit floats", [device.gl.RGBA8]: "bytes" };
    if (stage !== "rough")
      this.panel.status(`${width} × ${height}, ${painter.milliseconds.toFixed(0)} ms a frame, ${kept[device.exact]}, ${device.name}`);
    const root = document.documentElement;
    root.dataset.stage = stage;
    root.dataset.frames = String(Number(root.dataset.frames ?? 0) + 1); // for those who test the page
    root.dataset.ready ??= String(Math.round(performance.now()));
    if (data.materials.length > 1 && stage !== "rough") this.compare();
  }

  // The difference in numbers, of what is shown.
  compare() {
    const out = document.getElementById("difference"), { view, painter } = this;
    if (view.mode !== "difference" && view.mode !== "wipe") return;
    const [width, height] = painter.size;
    if (width * height > 4e6) return;
    const [a, b] = [view.a, view.b].map((index) => {
      const { gl } = this.device;
      gl.bindFramebuffer(gl.FRAMEBUFFER, painter.targetsOf(index).single.frame);
      return this.device.pixels(0, 0, width, height);
    });
    let difference = 0, total = 0, largest = 0;
    for (let i = 0; i < a.length; i++) {
      if (i % 4 === 3) continue;
      const apart = Math.abs(a[i] - b[i]);
      difference += apart;
      total += Math.abs(b[i]);
      largest = Math.max(largest, apart);
    }
    out.textContent = total ? `mean |A − B| is ${((100 * difference) / total).toPrecision(3)} % of the mean of B, the largest ${largest.toPrecision(3)}` : "";
  }

  changed() {
    this.panel.refresh();
    this.painter?.changed();
  }

  actions() {
    const page = this, { view } = this, limits = { stops: [-10, 10], tiling: [1 / 16, 64], gain: [1 / 16, 4096] };
    this.act = {
      turn(what, right, up) {
        if (what === "camera") view.camera.orbit(right, -up);
        else {
          view.lights[what].on = true;
          turnLight(view.lights[what], view.camera, right, up);
        }
        page.changed();
      },
      zoom(factor) {
        view.camera.zoom(factor);
        page.changed();
      },
      split(at) {
        view.split = clamp(at, 0, 1);
        page.shown();
      },
      set(name, value) {
        if (name === "mode" && (!MODES.includes(value) || view.count < 2)) return;
        if (name === "shape") {
          view.shape = page.data.shapes.find((shape) => shape.name === value);
          view.tiling = view.shape.tiling;
          view.camera.look(view.shape);
          page.texel?.forget();
        } else view[name] = limits[name] ? clamp(value, ...limits[name]) : value;
        if (name === "tiling") page.texel?.retiled();
        if (["stops", "tone", "gain", "held"].includes(name)) page.shown();
        else page.changed();
      },
      next(name) {
        const all = name === "tone" ? TONES : page.data.shapes.map((shape) => shape.name);
        const now = name === "tone" ? view.tone : view.shape.name;
        page.act.set(name, all[(all.indexOf(now) + 1) % all.length]);
      },
      swap() {
        [view.a, view.b] = [view.b, view.a];
        page.changed();
      },
      lit: () => page.changed(),
      reset() {
        view.lights.forEach((light, i) => Object.assign(light, TWO_LIGHTS[i]));
        view.camera.look(view.shape);
        Object.assign(view, { stops: 0, tiling: view.shape.tiling, split: 0.5 });
        page.texel?.forget();
        page.changed();
      },
      help() {
        const box = document.getElementById("help");
        box.hidden = !box.hidden;
      },
      forget() {
        document.getElementById("help").hidden = true;
        page.texel?.forget();
        page.shown();
      },
      pick: (x, y) => page.pick(x, y),
      rest: () => {},
    };
    return this.act;
  }

  // What is drawn stays, how it is shown changes.
  shown() {
    this.panel.refresh();
    if (!this.painter || this.painter.stopped) return;
    this.painter.redisplay();
    this.panel.overlay(this.painter.cells, this.texel.at);
    this.texel.draw();
  }

  // The texel at a place of the canvas, in its widths and heights; returns what was found.
  pick(u, v) {
    const { painter, canvas, texel } = this;
    if (!painter || painter.stopped) return null;
    const x = Math.floor(u * canvas.width), y = Math.floor(v * canvas.height);
    const cell = painter.cells.find(({ area: [left, bottom, w, h] }) => {
      const top = canvas.height - bottom - h;
      return x >= left && x < left + w && y >= top && y < top + h;
    });
    if (!cell) return null;
    const [left, bottom, , height] = cell.area, materials = painter.shown;
    const found = painter.pick(x - left, y - (canvas.height - bottom - height), materials);
    if (found.at) texel.set(found, materials);
    else texel.forget();
    this.panel.overlay(painter.cells, texel.at);
    return found;
  }
}

function failed(error) {
  document.documentElement.dataset.failed = error.message;
  complain(error.message);
  if (!(error instanceof NoWebGL)) throw error;
}

const page = new Page(JSON.parse(document.getElementById("data").textContent));
globalThis.viewer = page; // for consoles and tests
page.start().catch(failed);

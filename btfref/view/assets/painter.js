// When what is drawn: a rough picture at once, the whole one in bands, then more samples a pixel while nothing changes.
const BUDGET = 40; // milliseconds that a step may take
const LEAST_BAND = 8; // rows

class Painter {
  constructor(device, renderer, display, view) {
    Object.assign(this, { device, renderer, display, view });
    this.costs = []; // milliseconds a pixel, of each material
    this.targets = new Map();
    this.version = 1;
    this.drawn = 0;
    this.plan = null;
    this.pending = 0;
    this.stage = "rough"; // of what is shown: rough, single, summed
    this.heard = []; // called when a stage is shown
    this.stopped = false;
  }

  get cells() {
    const { width, height } = this.device.gl.canvas, { view } = this, whole = [0, 0, width, height];
    if (view.mode === "side") {
      const n = view.count, sides = (columns) => [width / columns, height / Math.ceil(n / columns)];
      const fits = [...Array(n).keys()].map((i) => i + 1).sort((a, b) => Math.min(...sides(b)) - Math.min(...sides(a)));
      const [w, h] = sides(fits[0]).map(Math.floor);
      return [...Array(n).keys()].map((i) => ({
        area: [(i % fits[0]) * w, height - (Math.floor(i / fits[0]) + 1) * h, w, h],
        materials: [i],
      }));
    }
    return [{ area: whole, materials: view.mode === "one" ? [view.a] : [view.a, view.b] }];
  }

  get shown() {
    return [...new Set(this.cells.flatMap((cell) => cell.materials))];
  }

  get size() {
    return this.cells[0].area.slice(2);
  }

  // What is seen has changed; how it is displayed has.
  changed() {
    this.version += 1;
    this.request();
  }

  redisplay() {
    if (this.drawn === this.version && !this.stopped && this.targets.size) this.present();
    if (!this.device.floats) this.changed();
  }

  request() {
    if (!this.pending && !this.stopped) this.pending = requestAnimationFrame(() => this.step());
  }

  step() {
    this.pending = 0;
    if (this.stopped) return;
    if (this.drawn !== this.version) this.begin();
    else if (this.plan) this.advance();
    if (this.plan) this.request();
  }

  // Targets of a material, of the size that is shown.
  targetsOf(index) {
    const [width, height] = this.size, { device } = this;
    let found = this.targets.get(index);
    if (!found || found.single.width !== width || found.single.height !== height) {
      this.release(found);
      const half = [Math.ceil(width / 2), Math.ceil(height / 2)];
      found = {
        // Floats of 4K would take half a gigabyte.
        single: device.target(width, height, width * height > 4e6 ? device.rough : device.exact),
        rough: device.target(...half, device.rough, { filtered: true }),
        sum: device.target(width, height, device.rough, { depth: false }),
        part: [1, 1],
      };
      this.targets.set(index, found);
    }
    return found;
  }

  release(targets) {
    if (targets) for (const name of ["single", "rough", "sum"]) targets[name].release();
  }

  source(index) {
    const targets = this.targetsOf(index);
    if (this.stage === "rough") return { picture: targets.rough, part: targets.part, weight: 1 };
    if (this.stage === "single") return { picture: targets.single, part: [1, 1], weight: 1 };
    return { picture: targets.sum, part: [1, 1], weight: 1 / this.summed };
  }

  present() {
    this.display.present(this.view, this.cells, (index) => this.source(index));
  }

  // Draw, wait, and learn what a pixel costs. Waiting keeps pages of slow renderers alive, and others do not notice.
  timed(index, target, options) {
    const start = performance.now();
    this.renderer.draw(index, target, options);
    const [x, y, width, height] = options.area ?? [0, 0, options.width, options.height];
    this.device.pixel(x, y);
    const spent = performance.now() - start, cost = spent / (width * height), known = this.costs[index];
    this.costs[index] = known ? 0.7 * known + 0.3 * cost : cost;
    return spent;
  }

  begin() {
    this.drawn = this.version;
    const [width, height] = this.size, { shown } = this;
    for (const index of [...this.targets.keys()].filter((index) => !shown.includes(index))) {
      this.release(this.targets.get(index));
      this.targets.delete(index);
    }
    for (const index of shown)
      if (this.costs[index] === undefined) {
        const side = Math.min(64, width, height), area = [(width - side) >> 1, (height - side) >> 1, side, side];
        this.timed(index, this.targetsOf(index).single, { width, height, area }); // compiles
        this.costs[index] = undefined;
        this.timed(index, this.targetsOf(index).single, { width, height, area });
      }
    const expected = shown.reduce((all, index) => all + this.costs[index], 0) * width * height;
    this.milliseconds = 0;
    if (expected <= BUDGET) {
      for (const index of shown) this.milliseconds += this.timed(index, this.targetsOf(index).single, { width, height });
      this.reached("single");
      this.plan = this.sampling(0);
      return;
    }
    const share = clamp(Math.sqrt(BUDGET / expected), 1 / 16, 0.5);
    const rough = [Math.max(Math.floor(share * width), 1), Math.max(Math.floor(share * height), 1)];
    for (const index of shown) {
      const targets = this.targetsOf(index);
      this.timed(index, targets.rough, { width: rough[0], height: rough[1] });
      targets.part = [rough[0] / targets.rough.width, rough[1] / targets.rough.height];
    }
    this.reached("rough");
    this.plan = { sample: -1, of: 0, row: 0, offset: [0.5, 0.5], share: 1 };
  }

  reached(stage) {
    this.stage = stage;
    this.present();
    for (const listener of this.heard) listener(stage);
  }

  // Plan of sample k of a regular grid in each pixel; null where there is none.
  sampling(k) {
    const n = Math.round(Math.sqrt(this.view.samples));
    if (n < 2 || k >= n * n || !this.device.floats) return null;
    return { sample: k, of: 0, row: 0, offset: [((k % n) + 0.5) / n, (Math.floor(k / n) + 0.5) / n], share: 1 / n };
  }

  advance() {
    const start = performance.now(), [width, height] = this.size, { shown } = this;
    while (this.plan && performance.now() - start < BUDGET) {
      const { plan } = this, index = shown[plan.of], { single } = this.targetsOf(index);
      const rows = clamp(Math.floor(BUDGET / (this.costs[index] * width)), LEAST_BAND, height - plan.row);
      const area = [0, plan.row, width, Math.min(rows, height - plan.row)];
      const spent = this.timed(index, single, { width, height, area, offset: plan.offset, share: plan.share });
      if (plan.sample < 0) this.milliseconds += spent;
      plan.row += area[3];
      if (plan.row < height) continue;
      Object.assign(plan, { row: 0, of: plan.of + 1 });
      if (plan.of === shown.length) this.finish(plan.sample);
    }
  }

  finish(sample) {
    if (sample < 0) this.reached("single");
    else {
      for (const index of this.shown) {
        const { single, sum } = this.targetsOf(index);
        this.display.add(single, sum, sample === 0);
      }
      this.summed = sample + 1;
      this.stage = "summed";
      this.present();
    }
    this.plan = this.sampling(sample + 1);
    if (!this.plan && sample >= 0) this.reached("summed");
  }

  // Radiance of materials at a pixel from the top left, and what is there; what is shown is drawn again.
  pick(x, y, materials) {
    const [width, height] = this.size, target = this.targetsOf(this.shown[0]).single;
    const at = this.renderer.point(this.shown[0], target, width, height, x, y);
    const radiance = materials.map((index) => {
      this.renderer.draw(index, target, { width, height, area: [x, height - 1 - y, 1, 1] });
      return [...this.device.pixel(x, height - 1 - y)];
    });
    this.changed();
    return { at, radiance };
  }
}

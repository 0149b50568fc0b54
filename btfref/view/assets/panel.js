// The controls beside the picture: they show the view and change it.
class Panel {
  constructor(data, view, act) {
    Object.assign(this, { data, view, act });
    this.byName = (name) => document.querySelector(`[data-view="${name}"]`);
    const options = (select, entries) => select.replaceChildren(...entries.map(([value, text]) => new Option(text, value)));
    const names = data.materials.map(({ name }, i) => [i, name]);
    options(this.byName("a"), names);
    options(this.byName("b"), names);
    options(this.byName("shape"), data.shapes.map(({ name }) => [name, name]));
    for (const one of document.querySelectorAll(".several")) one.hidden = names.length < 2;
    for (const name of ["a", "b"]) this.byName(name).addEventListener("change", (event) => act.set(name, Number(event.target.value)));
    for (const name of ["shape", "tone"]) this.byName(name).addEventListener("change", (event) => act.set(name, event.target.value));
    this.byName("samples").addEventListener("change", (event) => act.set("samples", Number(event.target.value)));
    // Sliders of what is a factor hold its logarithm.
    this.sliders = { stops: (x) => x, tiling: (x) => 2 ** x, gain: (x) => 2 ** x };
    for (const [name, value] of Object.entries(this.sliders))
      this.byName(name).addEventListener("input", (event) => act.set(name, value(Number(event.target.value))));
    for (const button of document.querySelectorAll("[data-mode]")) button.addEventListener("click", () => act.set("mode", button.dataset.mode));
    for (const button of document.querySelectorAll("[data-held]"))
      button.addEventListener("click", () => act.set("held", button.dataset.held === "camera" ? "camera" : Number(button.dataset.held)));
    for (const [name, does] of [["reset", act.reset], ["help", act.help], ["forget", act.forget]])
      for (const button of document.querySelectorAll(`[data-does="${name}"]`)) button.addEventListener("click", does);
    for (const input of document.querySelectorAll("[data-light]"))
      input.addEventListener("input", () => {
        const light = view.lights[Number(input.dataset.light)], { key } = input.dataset;
        light[key] = input.type === "checkbox" ? input.checked : input.type === "color" ? input.value : Number(input.value);
        act.lit();
      });
    this.facts();
  }

  facts() {
    const root = document.getElementById("facts");
    for (const { name, note, facts } of this.data.materials) {
      const details = document.createElement("details"), summary = document.createElement("summary"), pre = document.createElement("pre");
      summary.textContent = name;
      pre.textContent = facts.join("\n");
      details.open = this.data.materials.length === 1 && innerWidth > 900;
      details.append(summary);
      if (note) {
        const text = document.createElement("p"), notes = document.getElementById("notes");
        text.className = "note";
        text.textContent = this.data.materials.length > 1 ? `${name}: ${note}` : note;
        notes.append(text);
        notes.hidden = false;
      }
      details.append(pre);
      root.append(details);
    }
  }

  refresh() {
    const { view } = this, pressed = (button, on) => button.setAttribute("aria-pressed", String(on));
    for (const name of ["a", "b", "tone", "samples"]) this.byName(name).value = view[name];
    this.byName("shape").value = view.shape.name;
    for (const [name, value] of [["stops", view.stops], ["tiling", Math.log2(view.tiling)], ["gain", Math.log2(view.gain)]])
      this.byName(name).value = value;
    const signed = (x) => `${x < 0 ? "−" : "+"}${Math.abs(x).toFixed(1)}`;
    this.out("stops", `${signed(view.stops)} EV`);
    this.out("tiling", `${view.tiling.toPrecision(3)}×`);
    this.out("gain", `${view.gain.toPrecision(3)}×`);
    for (const input of document.querySelectorAll("[data-light]")) {
      const light = view.lights[Number(input.dataset.light)], value = light[input.dataset.key];
      if (input.type === "checkbox") input.checked = value;
      else input.value = value;
    }
    for (const box of document.querySelectorAll("[data-light-of]")) {
      const light = view.lights[Number(box.dataset.lightOf)];
      box.classList.toggle("off", !light.on);
      box.querySelector(".at").textContent = light.on ? `${light.azimuth.toFixed(0)}°, ${light.elevation.toFixed(0)}°, ${signed(light.stops)} EV` : "off";
    }
    for (const button of document.querySelectorAll("[data-mode]")) pressed(button, button.dataset.mode === view.mode);
    for (const button of document.querySelectorAll("[data-held]")) pressed(button, button.dataset.held === String(view.held));
    for (const one of document.querySelectorAll("[data-only]")) one.hidden = !one.dataset.only.split(" ").includes(view.mode);
    document.documentElement.dataset.mode = view.mode;
  }

  out(name, text) {
    document.querySelector(`[data-out="${name}"]`).textContent = text;
  }

  // Names over the pictures, the divider, the mark of the texel.
  overlay(cells, texel) {
    const root = document.getElementById("overlay"), { view } = this, { width, height } = document.getElementById("picture");
    const parts = [], add = (kind, text, x, y) => {
      const part = document.createElement("span");
      part.className = kind;
      part.textContent = text;
      Object.assign(part.style, { left: `${100 * x}%`, top: `${100 * y}%` });
      parts.push(part);
    };
    const several = this.data.materials.length > 1, name = (i) => this.data.materials[i].name;
    for (const { area: [x, y, w, h], materials: [a, b] } of cells) {
      const left = x / width, top = (height - y - h) / height;
      if (view.mode === "difference") add("tag", `${name(a)} − ${name(b)}`, left, top);
      else if (several) add("tag", name(a), left, top);
      if (view.mode === "wipe") {
        add("tag right", name(b), left + w / width, top);
        add("divider", "", left + (view.split * w) / width, top);
      }
      if (texel) {
        const [u, v] = view.camera.place(texel.place, w, h);
        if (u >= 0 && u <= 1 && v >= 0 && v <= 1) add("mark", "", left + (u * w) / width, top + (v * h) / height);
      }
    }
    root.replaceChildren(...parts);
  }

  status(text) {
    document.getElementById("status").textContent = text;
  }
}

// A message in place of the picture.
function complain(text) {
  const box = document.getElementById("message");
  box.textContent = text;
  box.hidden = !text;
}

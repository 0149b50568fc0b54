"use strict";
(() => {
  const root = document.documentElement;
  const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

  // --- numbers ----------------------------------------------------------------------------------------------------
  function show(x, digits = 3) {
    if (Number.isNaN(x)) return "NaN";
    if (!Number.isFinite(x)) return x > 0 ? "∞" : "−∞";
    if (x === 0) return "0";
    const a = Math.abs(x);
    const text = a >= 1e-3 && a < 1e5 ? String(Number(x.toPrecision(digits))) : x.toExponential(digits - 1).replace(/\.?0+e/, "e");
    return text.replace("e+", "e").replaceAll("-", "−");
  }

  // --- pixels: see btfref/report/pack.py ----------------------------------------------------------------------------
  let halves = null; // every half float, by its bits
  function halfTable() {
    if (halves) return halves;
    halves = new Float32Array(65536);
    for (let bits = 0; bits < 65536; bits++) {
      const exponent = (bits >> 10) & 31, mantissa = bits & 1023, sign = bits >> 15 ? -1 : 1;
      halves[bits] = exponent === 31 ? (mantissa ? NaN : sign * Infinity)
        : exponent ? sign * 2 ** (exponent - 15) * (1 + mantissa / 1024) : sign * 2 ** -24 * mantissa;
    }
    return halves;
  }
  // Pictures that several pages show stand in a script of their own.
  const whole = (packed) => (packed.shared ? globalThis.sharedPictures[packed.shared] : packed);
  async function inflate(text) {
    const raw = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
    const stream = new Blob([raw]).stream().pipeThrough(new DecompressionStream("deflate"));
    return new Response(stream).arrayBuffer();
  }
  async function unpack(packed, base) {
    const bytes = new Uint8Array(await inflate(packed.data));
    const { width, height, channels } = packed, n = width * height, table = halfTable();
    const values = new Float32Array(n * channels), codes = new Uint16Array(n * channels);
    for (let c = 0, i = 0; c < channels; c++)
      for (let y = 0; y < height; y++)
        for (let x = 0, code = 0; x < width; x++, i++) {
          const word = (bytes[i] << 8) | bytes[i + n * channels];
          code = packed.delta ? (code + word) & 65535 : word;
          codes[i] = base ? code ^ base.codes[i] : code;
          values[(y * width + x) * channels + c] = table[(codes[i] << packed.drop) & 65535] * packed.scale;
        }
    return { ...packed, data: null, values, codes };
  }

  // --- colours ------------------------------------------------------------------------------------------------------
  const DIVERGING = [[5, 48, 97], [67, 147, 195], [247, 247, 247], [214, 96, 77], [103, 0, 31]];
  // Magma and viridis of matplotlib (CC0) at equal steps.
  const MAGMA = [[0, 0, 4], [28, 16, 68], [79, 18, 123], [129, 37, 129], [181, 54, 122], [229, 80, 100], [251, 135, 97], [254, 194, 135], [252, 253, 191]];
  const VIRIDIS = [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137], [53, 183, 121], [109, 205, 89], [180, 222, 44], [253, 231, 37]];
  const CLASSES = [["background", [128, 134, 142]], ["interior", [64, 121, 201]], ["silhouette", [224, 140, 40]],
    ["mesostructure", [150, 90, 190]], ["edge", [96, 170, 130]], ["shadow_border", [200, 80, 90]],
    ["other", [120, 105, 60]]];
  function ramp(stops, t) {
    const p = clamp(t, 0, 1) * (stops.length - 1), i = Math.min(Math.floor(p), stops.length - 2), f = p - i;
    return stops[i].map((low, c) => low + f * (stops[i + 1][c] - low));
  }
  const table = (stops) => Array.from({ length: 512 }, (_, i) => ramp(stops, i / 511));
  const tables = { diverging: table(DIVERGING), magma: table(MAGMA), viridis: table(VIRIDIS) };
  const look = (name, t) => tables[name][Math.round(clamp(t, 0, 1) * 511)];
  const encode = Uint8ClampedArray.from({ length: 4096 }, (_, i) => {
    const x = (i / 4095) ** 2; // finer steps in the dark
    return 255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
  });
  const BAD = [255, 0, 255, 255]; // not finite

  function paint(layer, colour) {
    const { width, height, channels, values } = layer;
    const canvas = document.createElement("canvas");
    canvas.width = width; canvas.height = height;
    const context = canvas.getContext("2d"), picture = context.createImageData(width, height);
    for (let i = 0; i < width * height; i++) {
      let bad = false;
      for (let c = 0; c < channels; c++) bad ||= Number.isNaN(values[i * channels + c]);
      picture.data.set(bad ? BAD : colour(values, i), 4 * i);
    }
    context.putImageData(picture, 0, 0);
    return canvas;
  }
  function displayed(stops) {
    const gain = 2 ** stops, pixel = [0, 0, 0, 255];
    return (v, i) => {
      for (let c = 0; c < 3; c++) pixel[c] = encode[Math.round(Math.sqrt(clamp(v[3 * i + c] * gain, 0, 1)) * 4095)];
      return pixel;
    };
  }

  // --- one cell -------------------------------------------------------------------------------------------------------
  async function build(stage) {
    const data = JSON.parse(stage.querySelector("script.pixels").textContent);
    const images = {}, maps = {};
    for (const [label, packed] of Object.entries(data.images))
      images[label] = { ...(await unpack(whole(packed), images[packed.base])), name: packed.name };
    for (const [name, packed] of Object.entries(data.maps)) maps[name] = await unpack(whole(packed));
    const { width, height } = Object.values(images)[0];
    const view = { mode: "swipe", split: 0.5, second: false, stops: data.stops, zoom: 1, x: width / 2, y: height / 2 };
    const $ = (selector) => stage.querySelector(selector);
    const main = $(".frame.main"), pickA = $(".pick-a"), pickB = $(".pick-b");
    const frames = []; // { frame, canvas, picture }
    const background = (i) => maps.classes && Math.round(maps.classes.values[i]) === 0;

    function crop() {
      const w = width / view.zoom, h = height / view.zoom;
      return { x: clamp(view.x - w / 2, 0, width - w), y: clamp(view.y - h / 2, 0, height - h), w, h };
    }
    function blit(entry) {
      const { canvas, picture } = entry, scale = view.zoom > 1 ? 2 : 1, area = crop();
      canvas.width = width * scale; canvas.height = height * scale;
      const context = canvas.getContext("2d");
      context.imageSmoothingEnabled = false;
      context.drawImage(picture, area.x, area.y, area.w, area.h, 0, 0, canvas.width, canvas.height);
      entry.frame.classList.toggle("near", view.zoom > 1);
    }
    const a = { frame: main, canvas: $("canvas.a") }, b = { frame: main, canvas: $("canvas.b") };
    function repaint() {
      for (const [entry, pick, tag] of [[a, pickA, ".tag-a"], [b, pickB, ".tag-b"]]) {
        entry.picture = paint(images[pick.value], displayed(view.stops));
        $(tag).textContent = images[pick.value].name;
        blit(entry);
      }
      const change = view.stops - data.stops;
      $(".stops").value = change;
      $(".stops-out").textContent = `${view.stops >= 0 ? "+" : "−"}${show(Math.abs(view.stops))} EV`;
    }
    function arrange() {
      main.classList.toggle("mode-flip", view.mode === "flip");
      main.classList.toggle("mode-side", view.mode === "side");
      main.classList.toggle("second", view.second);
      main.style.setProperty("--split", `${100 * view.split}%`);
      for (const button of stage.querySelectorAll("[data-mode]"))
        button.setAttribute("aria-pressed", String(button.dataset.mode === view.mode));
    }
    function magnify(zoom, x = view.x, y = view.y) {
      Object.assign(view, { zoom: clamp(zoom, 1, 32), x, y });
      const area = crop();
      Object.assign(view, { x: area.x + area.w / 2, y: area.y + area.h / 2 });
      $(".zoom-out").textContent = `${view.zoom}×`;
      for (const entry of [a, b, ...frames]) blit(entry);
    }

    // Maps: title, what it says, colour of an entry, scale.
    function addMap(name, title, make) {
      if (!maps[name]) return;
      const figure = document.createElement("figure");
      figure.className = "map";
      figure.innerHTML = `<figcaption><b>${title}</b><span class="muted"></span></figcaption>` +
        '<div class="frame"><canvas></canvas><i class="cross"></i></div><div class="scale"></div>';
      $(".maps").append(figure);
      const entry = { frame: figure.querySelector(".frame"), canvas: figure.querySelector("canvas") };
      frames.push(entry);
      make({
        note: (text) => { figure.querySelector("figcaption .muted").textContent = text; },
        draw: (colour) => { entry.picture = paint(maps[name], colour); blit(entry); },
        scale: figure.querySelector(".scale"),
      });
    }
    function bar(scale, palette, ticks, limits = []) {
      let box = scale.querySelector(".legend");
      if (!box) {
        box = document.createElement("div");
        box.className = "legend";
        scale.prepend(box);
      }
      box.innerHTML = '<canvas width="256" height="1"></canvas><div class="ticks"></div>';
      const context = box.querySelector("canvas").getContext("2d"), line = context.createImageData(256, 1);
      for (let i = 0; i < 256; i++) line.data.set([...look(palette, i / 255), 255], 4 * i);
      context.putImageData(line, 0, 0);
      for (const [at, text, kind] of ticks) {
        const tick = document.createElement("span");
        tick.textContent = text;
        tick.style.left = `${100 * at}%`;
        tick.className = at === 1 ? "last" : kind ?? "";
        box.querySelector(".ticks").append(tick);
      }
      for (const [at, text] of limits) {
        const mark = document.createElement("i");
        mark.className = "limit";
        mark.style.left = `${100 * at}%`;
        mark.title = text;
        box.querySelector(".ticks").append(mark);
      }
    }
    function slider(scale, label, count, start, change) {
      const input = document.createElement("input");
      Object.assign(input, { type: "range", min: 0, max: count - 1, step: 1, value: start, title: label });
      input.setAttribute("aria-label", label);
      input.addEventListener("input", () => change(Number(input.value)));
      scale.append(input);
      change(start);
    }

    addMap("difference", "Signed difference", ({ note, draw, scale }) => {
      const steps = [];
      for (let power = -9; power <= 3; power++) for (const digit of [1, 2, 5]) steps.push(Number(`${digit}e${power}`));
      let start = steps.findIndex((step) => step >= data.full_scale * 0.999);
      if (start < 0) start = steps.length - 1;
      slider(scale, "full scale of the difference", steps.length, start, (k) => {
        const full = steps[k];
        note(`${data.pair.join(" − ")}, gain ${show(1 / full)}×`);
        bar(scale, "diverging", [[0, `−${show(full)}`], [0.5, "0"], [1, `+${show(full)}`]]);
        draw((v, i) => (v[i] === 0 && background(i) ? [0, 0, 0, 0] : [...look("diverging", 0.5 + v[i] / (2 * full)), 255]));
      });
    });
    addMap("relative", "Relative error", ({ note, draw, scale }) => {
      const place = (x) => (Math.log10(x) + 7) / 7;
      note("largest of the channels, logarithmic");
      bar(scale, "viridis", [[0, "1e−7"], [2 / 7, "1e−5", "minor"], [4 / 7, "1e−3"], [1, "1"]],
        data.limits.filter((x) => x > 1e-7 && x < 1).map((x) => [place(x), `limit ${show(x)}`]));
      draw((v, i) => (v[i] === 0 && background(i) ? [0, 0, 0, 0] : [...look("viridis", v[i] > 0 ? place(v[i]) : 0), 255]));
    });
    const linear = (name, title, meaning, steps, start) => addMap(name, title, ({ note, draw, scale }) => {
      let sum = 0, count = 0;
      for (const value of maps[name].values) if (!Number.isNaN(value)) { sum += value; count += 1; }
      note(`${meaning}, mean ${show(sum / count, 2)}`);
      slider(scale, `full scale of ${title}`, steps.length, start, (k) => {
        bar(scale, "magma", [[0, "0"], [0.5, show(steps[k] / 2)], [1, show(steps[k])]]);
        draw((v, i) => [...look("magma", v[i] / steps[k]), 255]);
      });
    });
    linear("flip", "HDR-FLIP", "visible when flipping", [1e-3, 1e-2, 1e-1, 1], 3);
    linear("delta_e00", "ΔE00", "colour as displayed", [0.01, 0.1, 1, 10, 100], 3);
    addMap("classes", "Pixel classes", ({ note, draw, scale }) => {
      note("judged apart");
      draw((v, i) => [...CLASSES[Math.round(v[i])][1], 255]);
      scale.innerHTML = '<div class="keys">' + CLASSES.map(([name, colour]) =>
        `<label><span class="swatch" style="background:rgb(${colour})"></span>${name}</label>`).join("") + "</div>";
    });
    addMap("p_value", "p-value", ({ note, draw, scale }) => {
      note("smallest of the channels, logarithmic");
      bar(scale, "magma", [[0, "1"], [0.5, "1e−4"], [1, "1e−8"]]);
      draw((v, i) => [...look("magma", -Math.log10(Math.max(v[i], 1e-9)) / 8), 255]);
    });

    // --- controls ---
    pickA.addEventListener("change", repaint);
    pickB.addEventListener("change", repaint);
    $(".stops").addEventListener("input", (event) => { view.stops = data.stops + Number(event.target.value); repaint(); });
    for (const button of stage.querySelectorAll("[data-mode]"))
      button.addEventListener("click", () => {
        if (view.mode === "flip" && button.dataset.mode === "flip") view.second = !view.second;
        view.mode = button.dataset.mode;
        arrange();
      });
    for (const button of stage.querySelectorAll("[data-zoom]"))
      button.addEventListener("click", () => magnify(button.dataset.zoom === "in" ? view.zoom * 2 : view.zoom / 2));
    $(".viewer").addEventListener("keydown", (event) => {
      if (event.target !== event.currentTarget) return;
      if (event.key === " " || event.key === "f") { view.mode = "flip"; view.second = !view.second; }
      else if (event.key === "ArrowLeft") view.split = clamp(view.split - 0.02, 0, 1);
      else if (event.key === "ArrowRight") view.split = clamp(view.split + 0.02, 0, 1);
      else return;
      event.preventDefault();
      arrange();
    });

    function pixelAt(event) {
      const box = event.currentTarget.getBoundingClientRect(), area = crop();
      const u = clamp((event.clientX - box.left) / box.width, 0, 0.999999), v = clamp((event.clientY - box.top) / box.height, 0, 0.999999);
      return { u, v, x: Math.floor(area.x + u * area.w), y: Math.floor(area.y + v * area.h) };
    }
    function read({ u, v, x, y }) {
      const i = y * width + x, parts = [`<span>x ${x}, y ${y}</span>`];
      if (maps.classes) parts[0] = `<span>x ${x}, y ${y}, ${CLASSES[Math.round(maps.classes.values[i])][0]}</span>`;
      for (const image of Object.values(images)) {
        const rgb = [0, 1, 2].map((c) => show(image.values[3 * i + c])).join(" ");
        const name = document.createElement("b");
        name.textContent = image.name;
        parts.push(`<span>${name.outerHTML} ${rgb}</span>`);
      }
      for (const [key, name] of [["difference", "difference"], ["relative", "relative"], ["flip", "FLIP"], ["delta_e00", "ΔE00"], ["p_value", "p"]])
        if (maps[key]) parts.push(`<span><b>${name}</b> ${show(maps[key].values[i], 2)}</span>`);
      $(".readout").innerHTML = parts.join(" ");
      stage.classList.add("pointing");
      for (const cross of stage.querySelectorAll(".cross")) Object.assign(cross.style, { left: `${100 * u}%`, top: `${100 * v}%` });
    }
    for (const canvas of [a.canvas, b.canvas, ...frames.map((entry) => entry.canvas)]) {
      const inMain = canvas === a.canvas || canvas === b.canvas;
      let drag = null;
      canvas.addEventListener("pointermove", (event) => {
        const at = pixelAt(event);
        if (drag) {
          if (drag.pan) {
            const box = canvas.getBoundingClientRect(), area = crop();
            magnify(view.zoom, drag.x - (event.clientX - drag.clientX) / box.width * area.w, drag.y - (event.clientY - drag.clientY) / box.height * area.h);
          } else { view.split = at.u; arrange(); }
        }
        read(at);
      });
      canvas.addEventListener("pointerdown", (event) => {
        const at = pixelAt(event), swipe = inMain && view.mode === "swipe";
        const onDivider = swipe && Math.abs(at.u - view.split) * canvas.clientWidth < 18;
        read(at);
        drag = { clientX: event.clientX, clientY: event.clientY, x: view.x, y: view.y, pan: !onDivider && view.zoom > 1 };
        if (!swipe && view.zoom === 1) drag = null;
        if (drag) canvas.setPointerCapture(event.pointerId);
        if (drag && !drag.pan) { view.split = at.u; arrange(); }
      });
      const release = () => { drag = null; };
      canvas.addEventListener("pointerup", release);
      canvas.addEventListener("pointercancel", release);
      canvas.addEventListener("pointerleave", () => stage.classList.remove("pointing"));
      canvas.addEventListener("click", () => { if (inMain && view.mode === "flip") { view.second = !view.second; arrange(); } });
      canvas.addEventListener("dblclick", (event) => {
        const { x, y } = pixelAt(event);
        magnify(view.zoom > 1 ? 1 : 8, x + 0.5, y + 0.5);
      });
    }
    arrange();
    repaint();
  }

  // --- page -------------------------------------------------------------------------------------------------------------
  const themes = ["automatic", "light", "dark"];
  const button = document.getElementById("theme");
  button.addEventListener("click", () => {
    const next = themes[(themes.indexOf(root.dataset.theme ?? "automatic") + 1) % 3];
    if (next === "automatic") delete root.dataset.theme; else root.dataset.theme = next;
    button.textContent = `Colours: ${next}`;
  });
  (async () => {
    let built = 0;
    const packed = document.getElementById("packed"); // the whole page, of which a report has hundreds
    if (packed) packed.outerHTML = new TextDecoder().decode(await inflate(packed.textContent));
    for (const stage of document.querySelectorAll(".stage")) { await build(stage); built += 1; }
    root.dataset.ready = String(built); // for those who print or test the page
  })().catch((error) => { root.dataset.failed = String(error); throw error; });
})();

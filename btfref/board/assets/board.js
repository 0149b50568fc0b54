"use strict";
const board = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);
const make = (kind, text = "", parent = null) => {
  const node = document.createElement(kind);
  node.textContent = text;
  if (parent) parent.append(node);
  return node;
};
const number = (x) => {
  if (x === null || x === undefined) return "–";
  if (x !== 0 && (Math.abs(x) >= 1e5 || Math.abs(x) < 1e-3)) return x.toExponential(2).replace("e+", "e");
  return String(Number(x.toPrecision(4)));
};
const bytes = (n) => {
  if (n === null || n === undefined) return "–";
  const steps = ["B", "kB", "MB", "GB"];
  let k = 0;
  while (n >= 1000 && k < 3) { n /= 1000; k += 1; }
  return `${Number(n.toPrecision(3))} ${steps[k]}`;
};

at("title").textContent = `${board.set} board, ${board.tier} tier`;
at("about").textContent =
  `Set ${board.set} ${board.set_version}; judged by btfref ${board.suite}. ${board.rows.length} rows, ` +
  `${Object.keys(board.materials).length} materials. Errors are at random places and directions that no method was ` +
  "fitted to, with the noise of the true values taken out; small figures are 99 % intervals.";

const fill = (id, entries) => entries.forEach(([value, text]) => {
  const option = make("option", text, at(id));
  option.value = value;
});
fill("material", [["", "all of them"], ...Object.entries(board.materials).map(([k, m]) => [k, `${k} (${m.family})`])]);
fill("footprint", board.footprints.map((k) => [k, k]));
fill("metric", Object.entries(board.metrics));

const higher = (metric) => metric === "psnr_log";
const state = { key: "rank", down: false };

// What a row shows: over all materials the mean, else those of one material.
const mean = (values) => {
  const some = values.filter((x) => x !== null && x !== undefined);
  return some.length ? some.reduce((s, x) => s + x, 0) / some.length : null;
};
const values = (row) => {
  const material = at("material").value, footprint = at("footprint").value, metric = at("metric").value;
  const names = material ? [material] : Object.keys(row.materials);
  const some = names.map((name) => row.materials[name]).filter(Boolean);
  if (!some.length) return null;
  const errors = some.map((m) => m.errors[footprint][metric]);
  const rank = row.rank[footprint];
  return {
    name: row.name,
    rank: material ? rank.places[material] : rank.place,
    from: material ? null : rank.from,
    to: material ? null : rank.to,
    score: material ? null : rank.score,
    error: mean(errors.map((e) => e[0])),
    low: material ? errors[0][1] : null,
    high: material ? errors[0][2] : null,
    bytes: mean(some.map((m) => m.bytes)),
    fit: mean(some.map((m) => m.fit_seconds)),
    numpy: row.evaluate_ns.numpy ?? null,
    drjit: row.evaluate_ns.drjit ?? null,
    glsl: row.evaluate_ns.glsl ?? null,
    energy: some.reduce((s, m) => (m.energy === undefined ? s : Math.max(s ?? 0, m.energy)), null),
    reciprocity: mean(some.map((m) => m.reciprocity)),
    count: some.length,
    row,
  };
};
const COLUMNS = [
  ["name", "method", (v) => v.name],
  ["rank", "rank", (v) => (v.rank === null ? "–" : String(v.rank))],
  ["score", "score", (v) => number(v.score)],
  ["error", "error", (v) => number(v.error)],
  ["bytes", "bytes", (v) => bytes(v.bytes)],
  ["fit", "fit, s", (v) => number(v.fit)],
  ["numpy", "NumPy, ns", (v) => number(v.numpy)],
  ["drjit", "Dr.Jit, ns", (v) => number(v.drjit)],
  ["glsl", "GLSL, ns", (v) => number(v.glsl)],
  ["energy", "energy", (v) => number(v.energy)],
  ["reciprocity", "reciprocity", (v) => number(v.reciprocity)],
  ["count", "materials", (v) => String(v.count)],
];

const heads = make("tr", "", document.querySelector("#table thead"));
COLUMNS.forEach(([key, label]) => {
  const head = make("th", "", heads);
  head.scope = "col";
  head.dataset.key = key;
  const button = make("button", label, head);
  button.type = "button";
  button.addEventListener("click", () => {
    state.down = state.key === key ? !state.down : false;
    state.key = key;
    draw();
  });
});

const draw = () => {
  const words = at("filter").value.toLowerCase().split(/\s+/).filter(Boolean);
  const shown = board.rows
    .filter((row) => {
      const text = [row.name, row.by ?? "", row.fitted].join(" ").toLowerCase();
      return words.every((word) => text.includes(word));
    })
    .map(values).filter(Boolean);
  const compare = (a, b) => {
    const [x, y] = [a[state.key], b[state.key]];
    // What is not known comes last, whichever way.
    if (x === null || x === undefined) return y === null || y === undefined ? 0 : 1;
    if (y === null || y === undefined) return -1;
    const order = typeof x === "string" ? x.localeCompare(y) : x - y;
    return state.down ? -order : order;
  };
  shown.sort(compare);
  document.querySelectorAll("#table th").forEach((head) => {
    const own = head.dataset.key === state.key;
    head.setAttribute("aria-sort", own ? (state.down ? "descending" : "ascending") : "none");
    const [, label] = COLUMNS.find(([key]) => key === head.dataset.key);
    head.firstChild.textContent = label + (own ? (state.down ? " ▼" : " ▲") : "");
  });
  const body = document.querySelector("#table tbody");
  body.replaceChildren();
  shown.forEach((v) => {
    const line = make("tr", "", body);
    if (v.rank === 1) line.className = "best";
    COLUMNS.forEach(([key, , text]) => {
      const cell = make("td", key === "name" ? "" : text(v), line);
      if (key === "name") {
        if (v.row.link) {
          const link = make("a", v.name, cell);
          link.href = v.row.link;
          link.rel = "noopener";
        } else cell.textContent = v.name;
        const who = [v.row.by, v.row.fitted, v.row.suite ? `btfref ${v.row.suite}` : "", `${v.row.set} ${v.row.set_version}`];
        make("small", who.filter(Boolean).join(", "), cell);
      }
      if (key === "rank" && v.from !== null) make("small", `${v.from} to ${v.to}`, cell);
      if (key === "error" && v.low !== null) make("small", `${number(v.low)} to ${number(v.high)}`, cell);
    });
  });
  if (!shown.length) make("td", "no rows", make("tr", "", body)).colSpan = COLUMNS.length;
  tell();
  side(shown);
};

const tell = () => {
  const material = board.materials[at("material").value];
  if (material) {
    const m = material.numbers;
    const noise = Object.entries(material.noise).map(([k, x]) => `${(100 * x).toPrecision(2)} % (${k})`).join(", ");
    at("facts").textContent =
      `${material.difficulty} Rank for 1 % error ${m.rank_1_percent}, parallax ${number(m.parallax)} tiles, ` +
      `dynamic range ${number(m.dynamic_range)}, indirect light ${(100 * m.indirect).toPrecision(2)} %, ` +
      `noise of the grids ${noise}.`;
  } else at("facts").textContent = "";
  at("legend").textContent =
    "Rank and score are by RMSE over RMS at the chosen footprint: the score is the geometric mean over materials of the error over the " +
    "smallest of the material, below 1 % counted as 1 %; small figures are the middle 90 % of ranks over random sets of materials. Over all " +
    "materials energy is the largest, all else are means; times are of the machine that handed the row in." +
    (higher(at("metric").value) ? " More PSNR is better." : "");
};

const side = (shown) => {
  const name = at("material").value || Object.keys(board.materials)[0];
  const place = at("pictures");
  place.replaceChildren();
  const add = (source, caption, wide) => {
    const figure = make("figure", "", place);
    if (wide) figure.className = "wide";
    const image = make("img", "", figure);
    image.src = source;
    image.alt = caption;
    image.loading = "lazy";
    make("figcaption", caption, figure);
  };
  add(board.materials[name].picture, `${name}, true: from above, under a low light, from the side`, true);
  shown.forEach((v) => {
    const found = v.row.materials[name];
    if (found && found.picture) {
      add(found.picture, `${v.name}, from the side, ${number(found.errors[at("footprint").value].nrmse[0])}`, false);
    }
  });
};

["material", "footprint", "metric", "filter"].forEach((id) => at(id).addEventListener("input", draw));
at("choices").addEventListener("submit", (event) => event.preventDefault());
draw();

"use strict";
// The matrix: which number its cells show, and which rows.
(() => {
  const table = document.querySelector(".matrix");
  const value = document.getElementById("value"), filter = document.getElementById("filter");
  if (!table) return;
  function refresh() {
    for (const cell of table.querySelectorAll("td[data-values]")) {
      // One each per option, in their order.
      cell.querySelector(".value").textContent = cell.dataset.values.split("|")[value.selectedIndex];
      cell.style.setProperty("--shade", cell.dataset.shades.split("|")[value.selectedIndex]);
    }
    table.dataset.shaded = String(value.value !== "outcome");
    for (const row of table.querySelectorAll("tbody tr"))
      row.hidden = filter.value !== "" && row.dataset.mesostructure !== filter.value;
  }
  value.addEventListener("change", refresh);
  filter.addEventListener("change", refresh);
  refresh();
  document.documentElement.dataset.matrix = "ready";
})();

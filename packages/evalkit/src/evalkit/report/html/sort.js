// Sorts tables by a click on a heading. Without this script they are plain tables in the order of the file.
"use strict";
{
  const status = document.createElement("p");
  status.className = "unseen";
  status.setAttribute("role", "status");
  document.body.append(status);

  // What a cell is sorted by: a number, a text, or null where it has no value.
  const valueOf = (row, place, isText) => {
    const cell = row.cells[place];
    const text = (cell.dataset.value ?? cell.textContent).trim();
    if (isText) return text || null;
    const number = Number.parseFloat(text.replace("\u2212", "-"));
    return Number.isNaN(number) ? null : number;
  };

  const compare = (a, b, isText) => (isText ? a.localeCompare(b, "en", { numeric: true }) : a - b);

  const positions = new Map(); // of each row in the file

  const sort = (table, heads, place) => {
    const head = heads[place];
    const ascending = head.getAttribute("aria-sort") !== "ascending";
    const isText = head.classList.contains("text");
    // Blocks of rows become one; totals stay where they are. Ties keep the order of the file.
    const bodies = [...table.tBodies].filter((body) => !body.classList.contains("total"));
    const rows = bodies.flatMap((body) => [...body.rows]).map((row) => [valueOf(row, place, isText), row]);
    rows.sort(([a, rowA], [b, rowB]) => {
      const nothing = (a === null) - (b === null); // no value: last, either way
      const order = nothing || (a === null ? 0 : ascending ? compare(a, b, isText) : compare(b, a, isText));
      return order || positions.get(rowA) - positions.get(rowB);
    });
    if (bodies.length) bodies[0].append(...rows.map(([, row]) => row));
    for (const other of heads) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", ascending ? "ascending" : "descending");
    status.textContent = `sorted by ${head.textContent.trim()}, ${head.getAttribute("aria-sort")}`;
  };

  for (const table of document.querySelectorAll("table.sortable")) {
    const heads = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
    for (const row of table.rows) positions.set(row, positions.size);
    heads.forEach((head, place) => {
      const button = document.createElement("button");
      button.type = "button";
      button.append(...head.childNodes);
      head.append(button);
      button.addEventListener("click", () => sort(table, heads, place));
    });
  }

  // Paper cannot be unfolded.
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = [...document.querySelectorAll("details:not([open])")];
    for (const fold of opened) fold.open = true;
  });
  addEventListener("afterprint", () => {
    for (const fold of opened) fold.open = false;
  });
}

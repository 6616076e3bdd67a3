// Tables that are sorted by a press on a head: least first, then greatest first. report.py calls
// this function with each table. What has no number stays last.
(table) => {
  const body = table.tBodies[0];
  const heads = [...table.tHead.rows[0].cells];
  const value = (row, column) => {
    // What failed has one cell for all columns.
    const cell = row.cells[column];
    const number = cell ? Number.parseFloat(cell.dataset.value) : NaN;
    return column === 0 ? row.cells[0].dataset.value.toLowerCase() : number;
  };
  const order = (one, other) => {
    const missing = Number.isNaN(one) - Number.isNaN(other);
    return missing || (one > other) - (one < other);
  };
  heads.forEach((head, column) => {
    head.querySelector("button")?.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const keyed = [...body.rows].map((row) => [value(row, column), row]);
      keyed.sort(([one], [other]) => {
        const last = Number.isNaN(one) || Number.isNaN(other);
        return down && !last ? order(other, one) : order(one, other);
      });
      body.append(...keyed.map(([, row]) => row));
    });
  });
}

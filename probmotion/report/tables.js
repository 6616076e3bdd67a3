// Sort a table by clicks on its headings, ascending and then descending. page.py calls this function
// with each table. Rows without a number stay last.
(table) => {
  const body = table.tBodies[0];
  const headings = [...table.tHead.rows[0].cells];
  const value = (row, column) => {
    // Rows of failures have one cell for all columns.
    const cell = row.cells[column];
    const number = cell ? Number.parseFloat(cell.dataset.value) : NaN;
    return column === 0 ? row.cells[0].dataset.value.toLowerCase() : number;
  };
  const order = (one, other) => {
    const missing = Number.isNaN(one) - Number.isNaN(other);
    return missing || (one > other) - (one < other);
  };
  headings.forEach((heading, column) => {
    heading.querySelector("button")?.addEventListener("click", () => {
      const down = heading.getAttribute("aria-sort") === "ascending";
      headings.forEach((other) => other.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", down ? "descending" : "ascending");
      const keyed = [...body.rows].map((row) => [value(row, column), row]);
      keyed.sort(([one], [other]) => {
        const last = Number.isNaN(one) || Number.isNaN(other);
        return down && !last ? order(other, one) : order(one, other);
      });
      body.append(...keyed.map(([, row]) => row));
    });
  });
}

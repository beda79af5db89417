// A click on a column's heading sorts the rows of its table by it, and another click the other way round.
const number = (text) => parseFloat(text.replace("−", "-").replace(/,/g, ""));
const compare = (a, b) => {
  const [x, y] = [number(a), number(b)];
  if (isNaN(x) || isNaN(y)) return isNaN(x) - isNaN(y) || a.localeCompare(b);
  return x - y;
};
for (const table of document.querySelectorAll("table.sorts")) {
  const body = table.tBodies[0];
  const headings = [...table.tHead.rows[table.tHead.rows.length - 1].cells];
  headings.forEach((heading, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener("click", () => {
      const up = heading.getAttribute("aria-sort") !== "ascending";
      headings.forEach((other) => other.removeAttribute("aria-sort"));
      heading.setAttribute("aria-sort", up ? "ascending" : "descending");
      const text = (row) => row.cells[column].textContent.trim();
      const missing = (row) => /^(—|unknown)?( |$)/.test(text(row));
      const rows = [...body.rows].sort((a, b) => missing(a) - missing(b) || (up ? 1 : -1) * compare(text(a), text(b)));
      body.append(...rows);
    });
  });
}
// What a link leads to may be folded away.
const open = () => document.getElementById(location.hash.slice(1))?.closest("details")?.setAttribute("open", "");
addEventListener("hashchange", open);
open();

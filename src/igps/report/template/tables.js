"use strict";
// Tables of the selected descriptor: scores per class, confusion between classes.

function element(name, attributes = {}, ...children) {
  const created = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined) created.setAttribute(key, value);
  }
  created.append(...children);
  return created;
}

function percent(share, digits = 1) {
  return share === null || share === undefined ? "–" : (100 * share).toFixed(digits);
}

// Colours a cell by a share between 0 and 1.
function tint(cell, share) {
  if (Number.isFinite(share)) cell.style.setProperty("--share", `${Math.round(100 * share)}%`);
}

const CLASS_COLUMNS = { nn: "NN", ft: "FT", st: "ST", dcg: "DCG", adr: "ADR", map: "mAP" };

// A table that is sorted by a click on a heading, and in the order of the classes at first.
function showClassScores(table, classes, shapes, perClass) {
  const rows = classes.map((name, index) => ({
    name,
    index,
    size: shapes.filter((shape) => shape.label === index).length,
    ...(perClass[index] ?? {}),
  }));
  const body = element("tbody");
  const columns = { name: "class", size: "shapes", ...CLASS_COLUMNS };
  const headings = Object.entries(columns).map(([key, title]) => {
    const button = element("button", { type: "button" }, title);
    const heading = element("th", { scope: "col", "aria-sort": key === "name" ? "ascending" : "none" }, button);
    button.addEventListener("click", () => {
      const ascending = heading.getAttribute("aria-sort") !== "ascending";
      headings.forEach((other) => other.setAttribute("aria-sort", other === heading ? (ascending ? "ascending" : "descending") : "none"));
      sort(key, ascending);
    });
    return heading;
  });
  function sort(key, ascending) {
    const value = (row) => (key === "name" ? row.index : (row[key] ?? -1));
    rows.sort((one, other) => (ascending ? 1 : -1) * (value(one) - value(other)));
    body.replaceChildren(...rows.map(line));
  }
  function line(row) {
    const cells = Object.keys(CLASS_COLUMNS).map((key) => {
      const cell = element("td", {}, percent(row[key]));
      tint(cell, row[key]);
      return cell;
    });
    const name = element("a", { href: `#class-${row.index}` }, row.name);
    return element("tr", {}, element("th", { scope: "row" }, name), element("td", {}, String(row.size)), ...cells);
  }
  sort("name", true);
  table.replaceChildren(element("thead", {}, element("tr", {}, ...headings)), body);
}

function showConfusion(table, classes, counts) {
  const headings = classes.map((name) => element("th", { scope: "col" }, element("span", {}, name)));
  const rows = counts.map((row, query) => {
    const total = row.reduce((sum, count) => sum + count, 0);
    const cells = row.map((count, found) => {
      if (!count) return element("td");
      const title = `${classes[query]}: ${count} of ${total} are ${classes[found]}`;
      const cell = element("td", { title, class: query === found ? "hit" : "miss" }, percent(count / total, 0));
      tint(cell, count / total);
      return cell;
    });
    return element("tr", {}, element("th", { scope: "row" }, classes[query]), ...cells);
  });
  const corner = element("th", { scope: "col" }, "query");
  table.replaceChildren(element("thead", {}, element("tr", {}, corner, ...headings)), element("tbody", {}, ...rows));
}

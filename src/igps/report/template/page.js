"use strict";
// Behaviour of the page: the search, the choice of a descriptor, and the dialog of a shape.

const byId = (id) => document.getElementById(id);
const data = JSON.parse(byId("data").textContent);
const { classes, shapes, systems } = data;
const pictures = new Pictures(shapes);
const wall = [...document.querySelectorAll("#shapes .shape")];
const buttonOf = new Map(wall.map((button) => [Number(button.dataset.shape), button]));
const dialog = byId("shape");
let turntable = null; // made when the first body is opened
let system = 0;
let current = null; // the shape in the dialog
const MAX_SELECTED = 120; // pictures below the map
let opener = null; // the picture that opened the dialog, if it is not on the wall

for (const descriptor of systems) {
  descriptor.row = new Map(descriptor.shapes.map((shape, row) => [shape, row]));
  descriptor.ranked = new Uint32Array(bytesOf(descriptor.ranked).buffer);
  descriptor.distances = new Float32Array(bytesOf(descriptor.distances).buffer);
}

// The shapes nearest to a shape, nearest first; null if the descriptor does not describe it.
function rankingOf(shape) {
  const chosen = systems[system];
  const row = chosen?.row.get(shape);
  if (row === undefined) return null;
  const indices = Array.from({ length: chosen.top }, (_, i) => row * chosen.top + i);
  return indices.map((i) => ({ shape: chosen.ranked[i], distance: chosen.distances[i] }));
}

// Whether the nearest shape is of the same class; null if this is unknown.
function isNearestRight(shape) {
  const first = rankingOf(shape)?.[0];
  const isScored = systems[system]?.per_query?.nn[systems[system].row.get(shape)] != null;
  return first && isScored ? shapes[first.shape].label === shapes[shape].label : null;
}

// A mark that does not depend on colour: a sign, and words for screen readers.
function setMark(container, isRight, words) {
  container.replaceChildren();
  if (isRight === null) return;
  container.append(
    element("span", { "aria-hidden": "true" }, isRight ? "✓" : "✗"),
    element("span", { class: "unseen" }, isRight ? words[0] : words[1]),
  );
}

function setHit(button, isRight) {
  button.classList.toggle("hit", isRight === true);
  button.classList.toggle("miss", isRight === false);
}

function chooseSystem(chosen) {
  system = chosen;
  for (const [shape, button] of buttonOf) {
    const isRight = isNearestRight(shape);
    setHit(button, isRight);
    setMark(button.querySelector(".mark"), isRight, ["nearest is of the same class", "nearest is of another class"]);
  }
  const descriptor = systems[system];
  if (descriptor && systems.length > 1) {
    document.querySelectorAll(".of-system").forEach((span) => (span.textContent = `, ${descriptor.name}`));
    document.querySelectorAll("[data-system]").forEach((curve) => {
      curve.classList.toggle("chosen", Number(curve.dataset.system) === system);
    });
  }
  if (byId("class-scores")) showClassScores(byId("class-scores"), classes, shapes, descriptor?.per_class ?? []);
  showChosenConfusion();
  showWorst();
  showMap();
  filter();
}

function showChosenConfusion() {
  if (!byId("confusion-table")) return;
  const counts = systems[system]?.confusion?.[byId("confusion-of").value] ?? [];
  showConfusion(byId("confusion-table"), classes, counts);
}

const searchTexts = shapes.map((shape) => [shape.name, classes[shape.label] ?? "", ...shape.notes].join(" ").toLowerCase());
const filters = [...document.querySelectorAll("select.filter")];
const placeOf = new Map([...buttonOf].map(([shape, button]) => [shape, button.closest("ul")]));

// The file of a shape: its name without the part.
function fileOf({ name, part }) {
  return part ? name.slice(0, -part.length - 1) : name;
}

// Lays the shapes of the wall by their classes, or those of one file together.
function arrange(isByFile) {
  byId("by-file").replaceChildren();
  const lists = new Map();
  for (const [shape, button] of buttonOf) {
    let list = placeOf.get(shape);
    if (isByFile) {
      const file = fileOf(shapes[shape]);
      if (!lists.has(file)) {
        lists.set(file, element("ul", { class: "wall" }));
        byId("by-file").append(element("section", { class: "class" }, element("h3", {}, file), lists.get(file)));
      }
      list = lists.get(file);
    }
    list.append(button.parentElement);
  }
  filter();
}

function filter() {
  const words = byId("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const only = byId("only").value;
  let count = 0;
  for (const [shape, button] of buttonOf) {
    const isShown =
      words.every((word) => searchTexts[shape].includes(word)) &&
      filters.every(({ value, dataset }) => !value || data.columns[dataset.column][shape] === value.slice(1)) &&
      (only !== "missed" || isNearestRight(shape) === false) &&
      (only !== "found" || isNearestRight(shape) === true) &&
      (only !== "repaired" || shapes[shape].notes.length > 0);
    button.parentElement.hidden = !isShown;
    count += isShown;
  }
  document.querySelectorAll("#shapes .class").forEach((section) => {
    section.hidden = !section.querySelector("li:not([hidden])");
  });
  byId("nothing").hidden = count > 0;
  const all = `${shapes.length} shape${shapes.length === 1 ? "" : "s"}`;
  byId("shown").textContent = count === shapes.length ? all : `${count} of ${all}`;
}

function fact(term, ...definition) {
  return element("div", {}, element("dt", {}, term), element("dd", {}, ...definition));
}

function factsOf(shape) {
  const { label, notes, mesh, part, potential, unit } = shapes[shape];
  const scores = systems[system]?.per_query;
  const row = systems[system]?.row.get(shape);
  const facts = [];
  if (part) facts.push(fact("part of the file", part));
  if (label >= 0) facts.push(fact("class", classes[label]));
  for (const [title, values] of Object.entries(data.columns)) {
    if (values[shape] != null) facts.push(fact(title, values[shape]));
  }
  if (scores && row !== undefined && scores.nn[row] !== null) {
    if (scores.rank) {
      facts.push(fact("rank of the other of its class", scores.rank[row]));
    } else {
      facts.push(fact("first tier", `${percent(scores.ft[row])} %`));
      facts.push(fact("second tier", `${percent(scores.st[row])} %`));
      facts.push(fact("average precision", `${percent(scores.map[row])} %`));
    }
  }
  if (mesh) {
    facts.push(fact("mesh", `${mesh[0].toLocaleString("en")} vertices, ${mesh[1].toLocaleString("en")} faces`));
    const units = unit ? [`${mesh[2]} ${unit}²`, `${mesh[3]} ${unit}³`] : [mesh[2], `${mesh[3]} (units of the file, squared and cubed)`];
    facts.push(fact("area, volume", units.join(", ")));
    facts.push(fact("potential", `${potential[0]} to ${potential[1]} on the surface`));
  }
  const repairs = notes.map((note) => element("div", {}, note));
  facts.push(fact("repairs", ...(repairs.length ? repairs : ["no repair was needed"])));
  return facts;
}

// A button with picture, name and class that opens a shape.
function picture(shape) {
  const canvas = element("canvas", { "data-shape": shape, width: 1, height: 1, "aria-hidden": "true" });
  const button = element(
    "button",
    { type: "button", class: "shape", "data-shape": shape, title: shapes[shape].name },
    canvas,
    element("span", { class: "name" }, shapes[shape].name),
    element("span", { class: "about" }, classes[shapes[shape].label] ?? ""),
  );
  pictures.watch(canvas);
  return button;
}

function card(query, { shape, distance }, rank) {
  const isRight = classes.length ? shapes[shape].label === shapes[query].label : null;
  const mark = element("span", { class: "mark" });
  setMark(mark, isRight, ["same class", "another class"]);
  const button = picture(shape);
  button.prepend(element("span", { class: "rank" }, element("span", { class: "unseen" }, "rank "), String(rank)));
  button.append(
    element("span", { class: "about" }, element("span", { class: "unseen" }, "distance "), distance.toPrecision(3)),
    mark,
  );
  setHit(button, isRight);
  return element("li", {}, button);
}

// A query beside the shapes of other classes that are ranked too high.
function confusion({ query, rank, wrong }) {
  const ranking = rankingOf(query);
  const descriptor = systems[system];
  const button = picture(query);
  button.append(element("span", { class: "about" }, "query"));
  const tiers = descriptor.per_query.ft; // none for classes of two
  const tier = tiers ? ` First tier: ${percent(tiers[descriptor.row.get(query)])} %.` : "";
  return element(
    "li",
    {},
    button,
    element("ol", { class: "wall" }, ...wrong.map((position) => card(query, ranking[position - 1], position))),
    element("p", {}, `First of the same class at rank ${rank} of ${descriptor.shapes.length - 1}.${tier}`),
  );
}

// A picture without a button.
function plainPicture(shape) {
  const canvas = element("canvas", { "data-shape": shape, width: 1, height: 1 });
  pictures.watch(canvas);
  return canvas;
}

const bodyMap = byId("map")
  ? new BodyMap(byId("map-plot"), byId("map-tip"), byId("map-legend"), {
      nameOf: (shape) => shapes[shape].name,
      open: (shape, mark) => {
        opener = mark;
        goTo(shape);
      },
      picture: plainPicture,
      onSelect: (selected) => {
        byId("map-chosen").textContent = selected.length ? `${selected.length} selected` : "";
        byId("map-selected").replaceChildren(...selected.slice(0, MAX_SELECTED).map((shape) => element("li", {}, picture(shape))));
        tree.mark(new Set(selected));
      },
    })
  : null;

const tree = bodyMap
  ? new ClusterTree(byId("tree-plot"), {
      titleOf: (selected, height) => {
        const { map, row } = systems[system];
        const numbers = new Set(selected.map((shape) => map.cluster[row.get(shape)]));
        const [number] = numbers;
        const isCluster = numbers.size === 1 && map.cluster.filter((cluster) => cluster === number).length === selected.length;
        const parts = [`${selected.length} shapes`, `distance ${Number(height.toPrecision(3))}`];
        return [...parts, ...(isCluster ? [`cluster ${number + 1}${stabilityOf(number)}`] : [])].join(", ");
      },
      select: (selected) => bodyMap.select(selected),
    })
  : null;

function stabilityOf(cluster) {
  const stability = systems[system].map.stability[cluster];
  return stability === null ? "" : `, stability ${stability.toFixed(2)}`;
}

function showMap() {
  if (!bodyMap) return;
  const { map, shapes: described } = systems[system];
  const { points, stress, tree: nodes, stability, n_stable } = map ?? { points: [], tree: [] };
  for (const name of ["map-plot", "tree-plot"]) byId(name).toggleAttribute("hidden", !map);
  byId("map-stress").textContent = map
    ? `The stress of the map is ${stress.toFixed(2)} (0: exact distances; above 0.2: strong distortion).`
    : "There is no map of these shapes.";
  byId("tree-summary").textContent = map ? `${n_stable} of ${stability.length} clusters are stable.` : "";
  tree.show(map ? described : [], nodes);
  bodyMap.show(points.map(([x, y], row) => ({ shape: described[row], x, y })));
  colourMap();
}

function colourMap() {
  const { map, row } = systems[system];
  const kind = byId("map-colour").value;
  const values = shapes.map((shape, i) => {
    if (kind === "class") return classes[shape.label];
    if (kind === "cluster") return map?.cluster[row.get(i)] ?? null;
    return kind === "volume" ? (shape.mesh?.[3] ?? null) : data.columns[kind.slice("column ".length)][i];
  });
  const titles = {
    cluster: (value) => (value === null ? "" : `cluster ${value + 1}${stabilityOf(value)}`),
    volume: (value) => (value === null ? "" : `volume ${value}`),
  };
  bodyMap.colour(values, titles[kind] ?? ((value) => value ?? ""));
  tree.colour(new Map(bodyMap.points.map(({ shape, mark }) => [shape, mark])));
}

function showWorst() {
  if (!byId("worst")) return;
  const worst = systems[system].worst;
  byId("worst-list").replaceChildren(...(worst ?? []).map(confusion));
  byId("worst-rankings").hidden = !worst?.length;
  byId("worst-none").hidden = Boolean(worst?.length);
  byId("worst-none").textContent = worst
    ? "There are no confusions: for every query, all shapes of its class are ranked first."
    : `${systems[system].name} describes no two shapes of one class.`;
}

function openShape(shape) {
  if (!shapes[shape]) return;
  current = shape;
  byId("shape-name").textContent = shapes[shape].name;
  byId("facts").replaceChildren(...factsOf(shape));
  const ranking = rankingOf(shape);
  const name = systems[system]?.name;
  byId("ranking").hidden = !systems.length;
  byId("ranking-heading").textContent = ranking
    ? `Nearest shapes by ${name}, ${ranking.length} of ${systems[system].shapes.length - 1}`
    : `${name} could not describe this shape; see the reason in the section Not used.`;
  byId("ranking-list").replaceChildren(...(ranking ?? []).map((neighbour, i) => card(shape, neighbour, i + 1)));
  const together = shapes[shape].together ?? [];
  byId("together").hidden = !together.length;
  byId("together-list").replaceChildren(...together.map((body) => element("li", {}, picture(body))));
  if (!dialog.open) dialog.showModal();
  turntable ??= new Turntable(byId("turntable"), [...byId("turntable-sides").children]);
  turntable.show(shapes[shape]);
  byId("turntable-hint").textContent = byId("turntable").hidden
    ? "There is no picture of this body."
    : "Drag or use the arrow keys to rotate, the wheel or + and − to zoom.";
  dialog.scrollTop = 0;
  // A card that had the focus was replaced; a button or the picture of the body keeps the focus.
  if (!dialog.contains(document.activeElement) || document.activeElement === dialog) byId("shape-name").focus();
}

// The shape in the dialog is part of the address, so that the Back button and links work.
function goTo(shape) {
  location.hash = `shape-${shape}`;
}

function followAddress() {
  const match = location.hash.match(/^#shape-(\d+)$/);
  if (match) openShape(Number(match[1]));
  else if (dialog.open) dialog.close();
}

// Opens the next or previous shape among those that match the search.
function step(by) {
  const shown = wall.filter((button) => !button.parentElement.hidden).map((button) => Number(button.dataset.shape));
  const index = shown.indexOf(current);
  if (shown.length) goTo(shown[(Math.max(index, 0) + by + shown.length) % shown.length]);
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  byId("theme").textContent = `Colours: ${theme}`;
  byId("theme").setAttribute("aria-label", `Colours: ${theme === "system" ? "system setting" : theme}`);
}

byId("theme").addEventListener("click", () => {
  const order = ["system", "light", "dark"];
  setTheme(order[(order.indexOf(document.documentElement.dataset.theme) + 1) % order.length]);
});
byId("search").addEventListener("input", filter);
byId("only").addEventListener("change", filter);
filters.forEach((select) => select.addEventListener("change", filter));
byId("order")?.addEventListener("change", (event) => arrange(event.target.value === "file"));
byId("controls").addEventListener("submit", (event) => event.preventDefault());
byId("system")?.addEventListener("change", (event) => chooseSystem(Number(event.target.value)));
byId("map-colour")?.addEventListener("change", colourMap);
byId("map-controls")?.addEventListener("submit", (event) => event.preventDefault());
byId("confusion-of")?.addEventListener("change", showChosenConfusion);
document.addEventListener("click", (event) => {
  const button = event.target.closest("button.shape");
  if (!button) return;
  if (!dialog.open) opener = buttonOf.get(Number(button.dataset.shape)) === button ? null : button;
  goTo(Number(button.dataset.shape));
});
byId("previous").addEventListener("click", () => step(-1));
byId("next").addEventListener("click", () => step(1));
byId("close").addEventListener("click", () => dialog.close());
dialog.addEventListener("click", (event) => {
  if (event.target === dialog) dialog.close(); // a click outside the dialog
});
dialog.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "ArrowLeft") step(-1);
  if (event.key === "ArrowRight") step(1);
});
dialog.addEventListener("close", () => {
  if (dialog.open) return; // the event comes late, when the next shape may be open already
  if (location.hash.startsWith("#shape-")) history.pushState(null, "", location.pathname + location.search);
  (opener ?? buttonOf.get(current))?.focus();
  opener = null;
});
window.addEventListener("hashchange", followAddress);
window.addEventListener("popstate", followAddress);

document.querySelectorAll("[data-share]").forEach((cell) => tint(cell, Number(cell.dataset.share)));
document.querySelectorAll("canvas[data-shape]").forEach((canvas) => pictures.watch(canvas));
setTheme("system");
chooseSystem(0);
followAddress();

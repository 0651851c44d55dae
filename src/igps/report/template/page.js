"use strict";
// What happens on the page: search, the choice of a descriptor, and the window of one shape.

const byId = (id) => document.getElementById(id);
const data = JSON.parse(byId("data").textContent);
const { classes, shapes, systems } = data;
const pictures = new Pictures(shapes);
const wall = [...document.querySelectorAll("#shapes .shape")];
const buttonOf = new Map(wall.map((button) => [Number(button.dataset.shape), button]));
const dialog = byId("shape");
let turntable = null; // made when the first body is opened
let system = 0;
let current = null; // the shape in the window
const MOST_SELECTED = 120; // pictures beside the map
let opener = null; // the picture that opened the window, if it is not on the wall

for (const one of systems) {
  one.row = new Map(one.shapes.map((shape, row) => [shape, row]));
  one.ranked = new Uint32Array(bytesOf(one.ranked).buffer);
  one.distances = new Float32Array(bytesOf(one.distances).buffer);
}

// The shapes nearest to one, nearest first; null where the descriptor does not know it.
function rankingOf(shape) {
  const one = systems[system];
  const row = one?.row.get(shape);
  if (row === undefined) return null;
  const places = Array.from({ length: one.top }, (_, i) => row * one.top + i);
  return places.map((place) => ({ shape: one.ranked[place], distance: one.distances[place] }));
}

// True, false, or null where it cannot be told.
function isNearestRight(shape) {
  const first = rankingOf(shape)?.[0];
  const isScored = systems[system]?.per_query?.nn[systems[system].row.get(shape)] != null;
  return first && isScored ? shapes[first.shape].label === shapes[shape].label : null;
}

// A mark that is told by its form and its words, too. The words are for those who hear the page.
function setMark(place, isRight, words) {
  place.replaceChildren();
  if (isRight === null) return;
  place.append(
    element("span", { "aria-hidden": "true" }, isRight ? "✓" : "✗"),
    element("span", { class: "unseen" }, isRight ? words[0] : words[1]),
  );
}

function setKind(button, isRight) {
  button.classList.toggle("hit", isRight === true);
  button.classList.toggle("miss", isRight === false);
}

function chooseSystem(chosen) {
  system = chosen;
  for (const [shape, button] of buttonOf) {
    const isRight = isNearestRight(shape);
    setKind(button, isRight);
    setMark(button.querySelector(".mark"), isRight, ["nearest is of the same class", "nearest is of another class"]);
  }
  const one = systems[system];
  if (one && systems.length > 1) {
    document.querySelectorAll(".of-system").forEach((place) => (place.textContent = `, ${one.name}`));
    document.querySelectorAll("[data-system]").forEach((place) => {
      place.classList.toggle("chosen", Number(place.dataset.system) === system);
    });
  }
  if (byId("class-scores")) showClassScores(byId("class-scores"), classes, shapes, one?.per_class ?? []);
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

const searched = shapes.map((shape) => [shape.name, classes[shape.label] ?? "", ...shape.notes].join(" ").toLowerCase());

function filter() {
  const words = byId("search").value.toLowerCase().split(/\s+/).filter(Boolean);
  const only = byId("only").value;
  let count = 0;
  for (const [shape, button] of buttonOf) {
    const isShown =
      words.every((word) => searched[shape].includes(word)) &&
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
  if (part) facts.push(fact("body of its file", part));
  if (label >= 0) facts.push(fact("class", classes[label]));
  if (scores && row !== undefined && scores.nn[row] !== null) {
    facts.push(fact("first tier", `${percent(scores.ft[row])} %`));
    facts.push(fact("second tier", `${percent(scores.st[row])} %`));
    facts.push(fact("average precision", `${percent(scores.map[row])} %`));
  }
  if (mesh) {
    facts.push(fact("mesh", `${mesh[0].toLocaleString("en")} vertices, ${mesh[1].toLocaleString("en")} faces`));
    const units = unit ? [`${mesh[2]} ${unit}²`, `${mesh[3]} ${unit}³`] : [mesh[2], `${mesh[3]} (units of the file, squared and cubed)`];
    facts.push(fact("area, volume", units.join(", ")));
    facts.push(fact("potential", `${potential[0]} to ${potential[1]} on the surface`));
  }
  const done = notes.map((note) => element("div", {}, note));
  facts.push(fact("repaired", ...(done.length ? done : ["nothing had to be done"])));
  return facts;
}

// A picture with name and class, which opens the shape.
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
  setKind(button, isRight);
  return element("li", {}, button);
}

// A query beside the wrong shapes that are too near to it.
function confusion({ query, rank, wrong }) {
  const ranking = rankingOf(query);
  const one = systems[system];
  const button = picture(query);
  button.append(element("span", { class: "about" }, "query"));
  const tier = percent(one.per_query.ft[one.row.get(query)]);
  return element(
    "li",
    {},
    button,
    element("ol", { class: "wall" }, ...wrong.map((place) => card(query, ranking[place - 1], place))),
    element("p", {}, `First of the same class at rank ${rank} of ${one.shapes.length - 1}. First tier: ${tier} %.`),
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
      told: (shape) => shapes[shape].name,
      open: (shape, mark) => {
        opener = mark;
        goTo(shape);
      },
      picture: plainPicture,
      changed: (selected) => {
        byId("map-chosen").textContent = selected.length ? `${selected.length} selected` : "";
        byId("map-selected").replaceChildren(...selected.slice(0, MOST_SELECTED).map((shape) => element("li", {}, picture(shape))));
        tree.mark(new Set(selected));
      },
    })
  : null;

const tree = bodyMap
  ? new ClusterTree(byId("tree-plot"), {
      told: (selected, height) => {
        const { map, row } = systems[system];
        const numbers = new Set(selected.map((shape) => map.cluster[row.get(shape)]));
        const [number] = numbers;
        const isCluster = numbers.size === 1 && map.cluster.filter((one) => one === number).length === selected.length;
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
  const one = systems[system];
  const { points, stress, tree: joinings, stability, n_stable } = one.map ?? { points: [], tree: [] };
  for (const name of ["map-plot", "tree-plot"]) byId(name).toggleAttribute("hidden", !one.map);
  byId("map-stress").textContent = one.map
    ? `Its stress is ${stress.toFixed(2)}: 0 would tell every distance, above 0.2 much is distorted.`
    : "There is no map of these shapes.";
  byId("tree-told").textContent = one.map ? `${n_stable} of ${stability.length} clusters are stable.` : "";
  tree.show(one.map ? one.shapes : [], joinings);
  bodyMap.show(points.map(([x, y], row) => ({ shape: one.shapes[row], x, y })));
  colourMap();
}

function colourMap() {
  const one = systems[system];
  const kind = byId("map-colour").value;
  const values = shapes.map((shape, i) => {
    if (kind === "class") return classes[shape.label];
    if (kind === "cluster") return one.map?.cluster[one.row.get(i)] ?? null;
    return kind === "volume" ? (shape.mesh?.[3] ?? null) : data.columns[kind.slice("column ".length)][i];
  });
  const titles = {
    cluster: (value) => (value === null ? "" : `cluster ${value + 1}${stabilityOf(value)}`),
    volume: (value) => (value === null ? "" : `volume ${value}`),
  };
  bodyMap.colour(values, titles[kind] ?? ((value) => value ?? ""));
  tree.colour(new Map(bodyMap.points.map(({ shape, mark }) => [shape, mark])));
}

// A shape and its nearest, painted from two sides.
function showExplained(shape) {
  const { other, told, values } = shapes[shape].explained ?? {};
  byId("explained").hidden = !told;
  if (!told) return;
  byId("explained-heading").textContent = `Where it differs from its nearest, ${shapes[other].name}`;
  byId("explained-told").textContent = `${told}. Red: unlike what corresponds to it in the other body; grey: alike.`;
  const painted = [shape, other].flatMap((one, place) =>
    ["front", "back"].map((side) => {
      const canvas = element("canvas", { width: 1, height: 1, role: "img", "aria-label": `${shapes[one].name}, ${side}` });
      pictures.paint(canvas, one, bytesOf(values[place]), side === "back");
      return element("li", { class: "painted" }, canvas, element("span", { class: "about" }, `${shapes[one].name}, ${side}`));
    }),
  );
  byId("explained-list").replaceChildren(...painted);
}

function showWorst() {
  if (!byId("worst")) return;
  const worst = systems[system].worst;
  byId("worst-list").replaceChildren(...(worst ?? []).map(confusion));
  byId("worst-some").hidden = !worst?.length;
  byId("worst-none").hidden = Boolean(worst?.length);
  byId("worst-none").textContent = worst
    ? "There are no confusions: every shape finds all others of its class first."
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
    ? `Nearest to it by ${name}, ${ranking.length} of ${systems[system].shapes.length - 1}`
    : `${name} could not describe this shape; the section Not used tells why.`;
  byId("ranking-list").replaceChildren(...(ranking ?? []).map((found, i) => card(shape, found, i + 1)));
  const together = shapes[shape].together ?? [];
  byId("together").hidden = !together.length;
  byId("together-list").replaceChildren(...together.map((one) => element("li", {}, picture(one))));
  showExplained(shape);
  const moves = Object.keys(data.movements).length > 0;
  byId("moved").hidden = !moves;
  if (moves) showMovements(byId("moved-table"), shapes[shape].name, data.movements);
  if (!dialog.open) dialog.showModal();
  turntable ??= new Turntable(byId("turntable"));
  turntable.show(shapes[shape].surface);
  byId("turntable-hint").textContent = byId("turntable").hidden
    ? "There is no picture of this body."
    : "Drag or use the arrow keys to turn, wheel or + and − to come closer.";
  dialog.scrollTop = 0;
  // The card that was chosen is gone; who holds a button or the body keeps it.
  if (!dialog.contains(document.activeElement) || document.activeElement === dialog) byId("shape-name").focus();
}

// The shape in the window is part of the address, so that Back goes back and a link leads to it.
function goTo(shape) {
  location.hash = `shape-${shape}`;
}

function followAddress() {
  const found = location.hash.match(/^#shape-(\d+)$/);
  if (found) openShape(Number(found[1]));
  else if (dialog.open) dialog.close();
}

// The next shape that the search lets through.
function step(by) {
  const shown = wall.filter((button) => !button.parentElement.hidden).map((button) => Number(button.dataset.shape));
  const place = shown.indexOf(current);
  if (shown.length) goTo(shown[(Math.max(place, 0) + by + shown.length) % shown.length]);
}

function setTheme(theme) {
  document.documentElement.dataset.theme = theme;
  byId("theme").textContent = `Colours: ${theme}`;
  byId("theme").setAttribute("aria-label", `Colours: ${theme === "system" ? "as the system" : theme}`);
}

byId("theme").addEventListener("click", () => {
  const order = ["system", "light", "dark"];
  setTheme(order[(order.indexOf(document.documentElement.dataset.theme) + 1) % order.length]);
});
byId("search").addEventListener("input", filter);
byId("only").addEventListener("change", filter);
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
  if (event.target === dialog) dialog.close(); // beside the window
});
dialog.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.key === "ArrowLeft") step(-1);
  if (event.key === "ArrowRight") step(1);
});
dialog.addEventListener("close", () => {
  if (dialog.open) return; // the browser tells of it late, when the next shape may be open already
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

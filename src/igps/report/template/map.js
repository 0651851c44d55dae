"use strict";
// The map: a point for each shape, which can be hovered, brushed, and reached by the keyboard.

const SVG = "http://www.w3.org/2000/svg";
// Circle, square, triangle: only seven colours can be distinguished, so further values use another marker.
const MARKS = ["M-4.5 0a4.5 4.5 0 1 0 9 0a4.5 4.5 0 1 0-9 0z", "M-4-4h8v8h-8z", "M0-5.4L5 4H-5z"];
const MAP_SIZE = 640;
const MIN_BRUSH = 4; // a shorter drag is a click
const MAX_CATEGORIES = 6; // columns with more different numbers are shown on a colour scale

function svgElement(name, attributes) {
  const created = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) created.setAttribute(key, value);
  return created;
}

class BodyMap {
  // Callbacks: `nameOf` and `picture` of a shape, `open` to open it, `onSelect` after a change of the selection.
  constructor(plot, tip, legend, { nameOf, open, picture, onSelect }) {
    Object.assign(this, { plot, tip, legend, nameOf, open, picture, onSelect });
    this.points = [];
    this.selected = new Set();
    this.brush = svgElement("rect", { class: "brush", "aria-hidden": "true" });
    this.start = null;
    plot.addEventListener("pointerdown", (event) => this.#pressed(event));
    plot.addEventListener("pointermove", (event) => this.#moved(event));
    plot.addEventListener("pointerup", (event) => this.#released(event));
    plot.addEventListener("pointerleave", () => this.#hideTip());
    plot.addEventListener("focusin", (event) => this.#showTip(event.target));
    plot.addEventListener("focusout", () => this.#hideTip());
    plot.addEventListener("keydown", (event) => this.#typed(event));
  }

  // Shows points [{shape, x, y}] in a box whose longer side is 1.
  show(points) {
    const height = Math.max(0, ...points.map(({ y }) => y)) * MAP_SIZE;
    this.plot.setAttribute("viewBox", `-16 -16 ${MAP_SIZE + 32} ${height + 32}`);
    this.points = points.map(({ shape, x, y }, i) => {
      const position = { x: MAP_SIZE * x, y: height - MAP_SIZE * y };
      const mark = svgElement("path", {
        role: "option",
        "data-point": shape,
        tabindex: i ? -1 : 0,
        transform: `translate(${position.x.toFixed(1)} ${position.y.toFixed(1)})`,
      });
      return { ...position, shape, mark };
    });
    this.plot.replaceChildren(...this.points.map(({ mark }) => mark), this.brush);
    this.select([]);
  }

  // Colours the points by values of the shapes: numbers on a colour scale, categories with a colour and marker each.
  colour(values, titleOf) {
    const shown = this.points.map(({ shape }) => values[shape]);
    const numbers = shown.map((value) => (value === null || value === "" ? NaN : Number(value)));
    const isScale = shown.every((value, i) => value == null || Number.isFinite(numbers[i])) && new Set(shown.filter((value) => value != null)).size > MAX_CATEGORIES;
    const finite = numbers.filter(Number.isFinite);
    const [low, high] = [Math.min(...finite), Math.max(...finite)];
    const names = [...new Set(shown)].sort((one, other) => String(one).localeCompare(String(other), "en", { numeric: true }));
    const counts = new Map();
    this.points.forEach(({ shape, mark }, i) => {
      const category = isScale ? 0 : names.indexOf(shown[i]);
      mark.setAttribute("d", MARKS[Math.floor(category / 7) % MARKS.length]);
      mark.setAttribute("class", isScale ? "scaled" : `colour-${category % 7}`);
      if (isScale && Number.isFinite(numbers[i])) mark.style.setProperty("--colour", scaleColour((numbers[i] - low) / (high - low || 1)));
      else mark.style.removeProperty("--colour");
      mark.setAttribute("aria-label", [this.nameOf(shape), titleOf(shown[i])].filter(Boolean).join(", "));
      counts.set(shown[i], (counts.get(shown[i]) ?? 0) + 1);
    });
    this.legend.replaceChildren(...(isScale ? [scaleLegend(low, high)] : names.map((name, category) => this.#legendEntry(name, category, titleOf, counts))));
  }

  select(shapes) {
    this.selected = new Set(shapes);
    for (const { shape, mark } of this.points) mark.setAttribute("aria-selected", this.selected.has(shape));
    this.plot.classList.toggle("selecting", this.selected.size > 0);
    this.onSelect([...this.selected]);
  }

  #legendEntry(name, category, titleOf, counts) {
    const mark = svgElement("svg", { viewBox: "-7 -7 14 14", "aria-hidden": "true" });
    mark.append(svgElement("path", { class: `colour-${category % 7}`, d: MARKS[Math.floor(category / 7) % MARKS.length] }));
    return element("li", {}, mark, titleOf(name) || "unknown", element("span", { class: "count" }, String(counts.get(name))));
  }

  #positionOf(event) {
    const matrix = this.plot.getScreenCTM();
    return { x: (event.clientX - matrix.e) / matrix.a, y: (event.clientY - matrix.f) / matrix.d };
  }

  #pressed(event) {
    if (event.button) return;
    this.start = this.#positionOf(event);
    this.before = event.shiftKey ? [...this.selected] : [];
    this.isBrushing = false;
    this.plot.setPointerCapture(event.pointerId);
  }

  #moved(event) {
    if (!this.start) {
      this.#showTip(event.target);
      return;
    }
    const end = this.#positionOf(event);
    const [left, right] = [Math.min(this.start.x, end.x), Math.max(this.start.x, end.x)];
    const [top, bottom] = [Math.min(this.start.y, end.y), Math.max(this.start.y, end.y)];
    this.isBrushing ||= Math.max(right - left, bottom - top) > MIN_BRUSH;
    if (!this.isBrushing) return;
    this.#hideTip();
    Object.entries({ x: left, y: top, width: right - left, height: bottom - top }).forEach(([key, value]) => {
      this.brush.setAttribute(key, value);
    });
    const inside = this.points.filter(({ x, y }) => x >= left && x <= right && y >= top && y <= bottom);
    this.select([...this.before, ...inside.map(({ shape }) => shape)]);
  }

  #released(event) {
    if (!this.start) return;
    this.start = null;
    this.brush.setAttribute("width", 0);
    if (this.isBrushing) return;
    const mark = document.elementFromPoint(event.clientX, event.clientY)?.closest("[data-point]");
    if (mark) this.open(Number(mark.dataset.point), mark);
    else this.select(this.before);
  }

  #typed(event) {
    const mark = event.target.closest("[data-point]");
    if (!mark || event.ctrlKey || event.metaKey || event.altKey) return;
    const shape = Number(mark.dataset.point);
    const directions = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    if (directions[event.key]) this.#step(this.points.find((point) => point.mark === mark), directions[event.key]);
    else if (event.key === "Enter") this.open(shape, mark);
    else if (event.key === " ") this.select(this.selected.has(shape) ? [...this.selected].filter((other) => other !== shape) : [...this.selected, shape]);
    else if (event.key === "Escape") this.select([]);
    else return;
    event.preventDefault();
  }

  // Moves the focus to the nearest point within 45° of a direction.
  #step(from, [right, down]) {
    let [best, lowestCost] = [null, Infinity];
    for (const point of this.points) {
      const along = (point.x - from.x) * right + (point.y - from.y) * down;
      const aside = Math.abs((point.x - from.x) * down) + Math.abs((point.y - from.y) * right);
      if (along > 0 && aside <= along && along + 2 * aside < lowestCost) [best, lowestCost] = [point, along + 2 * aside];
    }
    if (!best) return;
    from.mark.setAttribute("tabindex", -1);
    best.mark.setAttribute("tabindex", 0);
    best.mark.focus();
  }

  #showTip(target) {
    const mark = target.closest("[data-point]");
    if (!mark) {
      this.#hideTip();
      return;
    }
    const shape = Number(mark.dataset.point);
    if (this.tip.dataset.of !== String(shape)) {
      this.tip.replaceChildren(this.picture(shape), element("span", {}, mark.getAttribute("aria-label")));
      this.tip.dataset.of = shape;
    }
    this.tip.hidden = false;
    const frame = this.tip.parentElement.getBoundingClientRect();
    const box = mark.getBoundingClientRect();
    const left = Math.min(box.right - frame.left + 6, frame.width - this.tip.offsetWidth);
    this.tip.style.setProperty("left", `${Math.max(0, left)}px`);
    this.tip.style.setProperty("top", `${box.bottom - frame.top + 6}px`);
  }

  #hideTip() {
    this.tip.hidden = true;
  }
}

function scaleColour(share) {
  const first = 3 * Math.round(255 * share);
  return `#${new THREE.Color(...colourTable.subarray(first, first + 3)).getHexString()}`;
}

function scaleLegend(low, high) {
  const bar = svgElement("svg", { viewBox: "0 0 9 1", preserveAspectRatio: "none", "aria-hidden": "true" });
  bar.append(svgElement("rect", { width: 9, height: 1, fill: "url(#potential-scale)" }));
  const [smallest, largest] = [low, high].map((value) => Number(value.toPrecision(4)).toLocaleString("en"));
  return element("li", { class: "scale" }, element("span", {}, smallest), bar, element("span", {}, largest));
}

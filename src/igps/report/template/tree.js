"use strict";
// The tree of clusters: an arch for each two branches that join, as high as they are apart. An arch selects its shapes.

const TREE_HEIGHT = 240;
const LEAF_HEIGHT = 10;
const LOWEST_ARCH = 2; // of bodies at no distance, so that it can be pointed at

class ClusterTree {
  // `told` gives the words for a branch of shapes at a height, `select` selects them.
  constructor(plot, { told, select }) {
    Object.assign(this, { plot, told, select });
    this.branches = [];
    this.leaves = [];
    plot.addEventListener("click", (event) => this.#choose(event.target));
    plot.addEventListener("keydown", (event) => this.#typed(event));
  }

  // `shapes` by row, and of each joining, the lowest first, [branch, branch, height]; rows come before joinings.
  show(shapes, joinings) {
    const nodes = [...shapes.map((shape) => ({ shape })), ...joinings.map(([one, other, height]) => ({ parts: [one, other], height }))];
    const highest = joinings.at(-1)?.[2] || 1;
    this.leaves = [];
    const ahead = nodes.length ? [nodes.length - 1] : [];
    while (ahead.length) {
      const node = nodes[ahead.pop()];
      if (node.parts) ahead.push(node.parts[1], node.parts[0]);
      else this.leaves.push(node);
    }
    const width = MAP_SIZE / Math.max(1, this.leaves.length);
    this.leaves.forEach((leaf, place) => {
      const left = place * width;
      const d = `M${left.toFixed(2)} ${TREE_HEIGHT}h${width.toFixed(2)}v${LEAF_HEIGHT}h-${width.toFixed(2)}z`;
      Object.assign(leaf, { x: left + width / 2, y: TREE_HEIGHT, first: place, n: 1, mark: svgElement("path", { d, "data-leaf": leaf.shape }) });
    });
    this.branches = nodes.filter(({ parts }) => parts);
    for (const branch of this.branches) {
      const [one, other] = (branch.inner = branch.parts.map((part) => nodes[part]));
      for (const part of branch.inner) part.outer = branch;
      const y = Math.min(TREE_HEIGHT * (1 - branch.height / highest), Math.min(one.y, other.y) - LOWEST_ARCH);
      Object.assign(branch, { x: (one.x + other.x) / 2, y, first: Math.min(one.first, other.first), n: one.n + other.n });
      const d = `M${one.x.toFixed(2)} ${one.y.toFixed(2)}V${y.toFixed(2)}H${other.x.toFixed(2)}V${other.y.toFixed(2)}`;
      branch.mark = svgElement("path", { d, class: "branch", role: "option", tabindex: -1 });
      branch.mark.setAttribute("aria-label", this.told(this.#shapesOf(branch), branch.height));
      branch.mark.append(svgElement("title", {}));
      branch.mark.firstChild.textContent = branch.mark.getAttribute("aria-label");
    }
    const root = this.branches.at(-1);
    root?.mark.setAttribute("tabindex", 0);
    const top = Math.min(0, root?.y ?? 0) - 6;
    this.plot.setAttribute("viewBox", `-16 ${top.toFixed(1)} ${MAP_SIZE + 32} ${(TREE_HEIGHT + LEAF_HEIGHT + 6 - top).toFixed(1)}`);
    // Lower arches lie over higher ones, whose area has them inside
    this.plot.replaceChildren(...this.branches.map(({ mark }) => mark).reverse(), ...this.leaves.map(({ mark }) => mark));
  }

  // The colours that the marks of the shapes have on the map.
  colour(marks) {
    for (const { shape, mark } of this.leaves) {
      mark.setAttribute("class", marks.get(shape).getAttribute("class"));
      mark.style.setProperty("--colour", marks.get(shape).style.getPropertyValue("--colour"));
    }
  }

  mark(selected) {
    for (const { shape, mark } of this.leaves) mark.classList.toggle("faint", selected.size > 0 && !selected.has(shape));
    for (const branch of this.branches) {
      const isWhole = selected.size === branch.n && this.#shapesOf(branch).every((shape) => selected.has(shape));
      branch.mark.setAttribute("aria-selected", isWhole);
    }
  }

  #shapesOf({ first, n }) {
    return this.leaves.slice(first, first + n).map(({ shape }) => shape);
  }

  #choose(target) {
    const branch = this.branches.find(({ mark }) => mark === target);
    if (!branch) return;
    this.#walkTo(branch);
    this.select(this.#shapesOf(branch));
  }

  #typed(event) {
    const branch = this.branches.find(({ mark }) => mark === event.target);
    if (!branch || event.ctrlKey || event.metaKey || event.altKey) return;
    const ways = { ArrowUp: branch.outer, ArrowLeft: branch.inner[0], ArrowRight: branch.inner[1], ArrowDown: branch.inner.find(({ parts }) => parts) };
    if (event.key in ways) this.#walkTo(ways[event.key]);
    else if (event.key === "Enter" || event.key === " ") this.select(this.#shapesOf(branch));
    else if (event.key === "Escape") this.select([]);
    else return;
    event.preventDefault();
  }

  #walkTo(branch) {
    if (!branch?.parts) return;
    for (const { mark } of this.branches) mark.setAttribute("tabindex", mark === branch.mark ? 0 : -1);
    branch.mark.focus();
  }
}

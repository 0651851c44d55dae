"use strict";
// The tree of clusters: an arch joins two branches at the height of their distance; a click on it selects its shapes.

const TREE_HEIGHT = 240;
const LEAF_HEIGHT = 10;
const MIN_ARCH_HEIGHT = 2; // so that an arch at distance 0 can be clicked

class ClusterTree {
  // Callbacks: `titleOf` the shapes of a branch and its height, `select` to select shapes.
  constructor(plot, { titleOf, select }) {
    Object.assign(this, { plot, titleOf, select });
    this.branches = [];
    this.leaves = [];
    plot.addEventListener("click", (event) => this.#choose(event.target));
    plot.addEventListener("keydown", (event) => this.#typed(event));
  }

  // Shows the tree of `shapes` and `joins`, [child, child, height], the lowest first. The child with a number below
  // the number N of shapes is a shape, child N + i is join i.
  show(shapes, joins) {
    const nodes = [...shapes.map((shape) => ({ shape })), ...joins.map(([one, other, height]) => ({ parts: [one, other], height }))];
    const highest = joins.at(-1)?.[2] || 1;
    this.leaves = [];
    const stack = nodes.length ? [nodes.length - 1] : [];
    while (stack.length) {
      const node = nodes[stack.pop()];
      if (node.parts) stack.push(node.parts[1], node.parts[0]);
      else this.leaves.push(node);
    }
    const width = MAP_SIZE / Math.max(1, this.leaves.length);
    this.leaves.forEach((leaf, index) => {
      const left = index * width;
      const d = `M${left.toFixed(2)} ${TREE_HEIGHT}h${width.toFixed(2)}v${LEAF_HEIGHT}h-${width.toFixed(2)}z`;
      Object.assign(leaf, { x: left + width / 2, y: TREE_HEIGHT, first: index, n: 1, mark: svgElement("path", { d, "data-leaf": leaf.shape }) });
    });
    this.branches = nodes.filter(({ parts }) => parts);
    for (const branch of this.branches) {
      const [one, other] = (branch.inner = branch.parts.map((part) => nodes[part]));
      for (const part of branch.inner) part.outer = branch;
      const y = Math.min(TREE_HEIGHT * (1 - branch.height / highest), Math.min(one.y, other.y) - MIN_ARCH_HEIGHT);
      Object.assign(branch, { x: (one.x + other.x) / 2, y, first: Math.min(one.first, other.first), n: one.n + other.n });
      const d = `M${one.x.toFixed(2)} ${one.y.toFixed(2)}V${y.toFixed(2)}H${other.x.toFixed(2)}V${other.y.toFixed(2)}`;
      branch.mark = svgElement("path", { d, class: "branch", role: "option", tabindex: -1 });
      branch.mark.setAttribute("aria-label", this.titleOf(this.#shapesOf(branch), branch.height));
      branch.mark.append(svgElement("title", {}));
      branch.mark.firstChild.textContent = branch.mark.getAttribute("aria-label");
    }
    const root = this.branches.at(-1);
    root?.mark.setAttribute("tabindex", 0);
    const top = Math.min(0, root?.y ?? 0) - 6;
    this.plot.setAttribute("viewBox", `-16 ${top.toFixed(1)} ${MAP_SIZE + 32} ${(TREE_HEIGHT + LEAF_HEIGHT + 6 - top).toFixed(1)}`);
    // Lower arches are drawn over the higher arches that enclose them
    this.plot.replaceChildren(...this.branches.map(({ mark }) => mark).reverse(), ...this.leaves.map(({ mark }) => mark));
  }

  // Colours the leaves as the marks of their shapes on the map.
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
    this.#focus(branch);
    this.select(this.#shapesOf(branch));
  }

  #typed(event) {
    const branch = this.branches.find(({ mark }) => mark === event.target);
    if (!branch || event.ctrlKey || event.metaKey || event.altKey) return;
    const neighbours = { ArrowUp: branch.outer, ArrowLeft: branch.inner[0], ArrowRight: branch.inner[1], ArrowDown: branch.inner.find(({ parts }) => parts) };
    if (event.key in neighbours) this.#focus(neighbours[event.key]);
    else if (event.key === "Enter" || event.key === " ") this.select(this.#shapesOf(branch));
    else if (event.key === "Escape") this.select([]);
    else return;
    event.preventDefault();
  }

  #focus(branch) {
    if (!branch?.parts) return;
    for (const { mark } of this.branches) mark.setAttribute("tabindex", mark === branch.mark ? 0 : -1);
    branch.mark.focus();
  }
}

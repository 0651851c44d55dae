"use strict";
// Bodies: their surfaces, small pictures of them, and a picture that can be rotated.

// From the smallest to the largest potential; the order is visible to colour-blind readers (viridis, van der Walt and Smith).
const COLOURS = ["#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];
const FIELD_OF_VIEW = 26;
const MILLISECONDS_PER_FRAME = 12;

const packedSurfaces = document.getElementById("surfaces").textContent.trim().split("\n");

function bytesOf(letters) {
  return Uint8Array.from(atob(letters), (letter) => letter.charCodeAt(0));
}

// The 256 colours of the potential, as RGB triples in the linear colour space of three.js.
const colourTable = (() => {
  const stops = COLOURS.map((colour) => new THREE.Color(colour));
  const table = new Float32Array(3 * 256);
  for (let i = 0; i < 256; i++) {
    const position = (i / 255) * (stops.length - 1);
    const first = Math.min(Math.floor(position), stops.length - 2);
    stops[first].clone().lerp(stops[first + 1], position - first).toArray(table, 3 * i);
  }
  return table;
})();

// The geometry of a surface [index, number of vertices, number of faces], centred at the origin with a longest side of 1,
// coloured by the potential.
function geometryOf([index, nVertices, nFaces]) {
  const { buffer } = bytesOf(packedSurfaces[index]);
  const steps = new Uint16Array(buffer, 0, 3 * nVertices);
  const faces = new Uint16Array(buffer, 6 * nVertices, 3 * nFaces);
  const potential = new Uint8Array(buffer, 6 * (nVertices + nFaces), nVertices);
  const positions = Float32Array.from(steps, (step) => step / 65535 - 0.5);
  const colours = new Float32Array(3 * nVertices);
  potential.forEach((value, i) => colours.set(colourTable.subarray(3 * value, 3 * value + 3), 3 * i));
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setAttribute("color", new THREE.BufferAttribute(colours, 3));
  geometry.setIndex(new THREE.BufferAttribute(faces, 1));
  geometry.computeVertexNormals();
  geometry.computeBoundingSphere();
  return geometry;
}

// A scene with one body, drawn on a transparent background.
class Stage {
  constructor(canvas) {
    this.renderer = new THREE.WebGLRenderer({ canvas, alpha: true, antialias: true });
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.05, 50);
    const lamp = new THREE.DirectionalLight(0xffffff, 2.1);
    lamp.position.set(0.6, 1.0, 1.2);
    this.camera.add(lamp);
    this.scene = new THREE.Scene();
    this.scene.add(this.camera, new THREE.HemisphereLight(0xffffff, 0x8890a0, 1.7));
    const material = new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.75, side: THREE.DoubleSide });
    this.body = new THREE.Mesh(new THREE.BufferGeometry(), material);
    this.scene.add(this.body);
  }

  show({ surface, frame }) {
    this.frame = frame;
    this.body.geometry.dispose();
    this.body.geometry = geometryOf(surface);
    const { center, radius } = this.body.geometry.boundingSphere;
    this.body.position.copy(center).negate();
    this.distance = radius / Math.sin((FIELD_OF_VIEW * Math.PI) / 360);
    // From the front, a little from the right and from above, which shows depth
    this.camera.position.set(0.46, 0.26, 0.85).setLength(this.distance);
    this.camera.lookAt(0, 0, 0);
  }

  draw() {
    this.renderer.render(this.scene, this.camera);
  }

  // The sides of the patient at the left, right, lower and upper edge; none if they are not known.
  sides() {
    if (!this.frame) return [];
    this.camera.updateMatrixWorld();
    const axes = this.camera.matrixWorld.elements;
    const right = [axes[0], axes[1], axes[2]];
    const up = [axes[4], axes[5], axes[6]];
    return [right.map((x) => -x), right, up.map((x) => -x), up].map(sideOf);
  }
}

// The letter of the patient's side to which a direction points: surfaces of a patient have x to the left, y up, z to the front.
function sideOf(direction) {
  const axis = direction.map(Math.abs).reduce((best, size, i, sizes) => (size > sizes[best] ? i : best), 0);
  return ["RL", "IS", "PA"][axis][Number(direction[axis] > 0)];
}

// Writes letters at the left, right, lower and upper edge of a square picture.
function writeSides(canvas, sides) {
  const context = canvas.getContext("2d");
  const [size, margin] = [canvas.width, canvas.width / 14];
  context.font = `${Math.round(size / 9)}px sans-serif`;
  context.fillStyle = "#808080";
  context.textAlign = "center";
  context.textBaseline = "middle";
  const places = [[margin, size / 2], [size - margin, size / 2], [size / 2, size - margin], [size / 2, margin]];
  sides.forEach((letter, i) => context.fillText(letter, ...places[i]));
}

// A stage on a canvas; null if the browser has no WebGL.
function stageOn(canvas) {
  try {
    return new Stage(canvas);
  } catch {
    document.documentElement.classList.add("without-3d");
    return null;
  }
}

// Small pictures, each drawn when it comes near the visible part of the page.
class Pictures {
  constructor(shapes) {
    this.shapes = shapes;
    this.source = document.createElement("canvas");
    this.stage = stageOn(this.source);
    this.drawn = new Map(); // from shapes to canvases that show them
    this.waiting = new Set();
    this.isPlanned = false;
    this.watcher = new IntersectionObserver((entries) => this.#arrived(entries), { rootMargin: "300px" });
    if (this.stage) {
      this.size = Math.round(96 * Math.min(2, Math.max(1.5, window.devicePixelRatio)));
      this.stage.renderer.setSize(this.size, this.size, false);
    }
    window.addEventListener("beforeprint", () => this.drawAll());
  }

  // Draws a shape on a canvas when the canvas comes near the visible part of the page.
  watch(canvas) {
    if (this.stage && this.shapes[canvas.dataset.shape].surface) {
      this.watcher.observe(canvas);
    }
  }

  drawAll() {
    document.querySelectorAll("canvas[data-shape]:not(.drawn)").forEach((canvas) => this.#draw(canvas));
    this.waiting.clear();
  }

  #arrived(entries) {
    for (const { target, isIntersecting } of entries) {
      if (isIntersecting) this.waiting.add(target);
      else this.waiting.delete(target);
    }
    this.#plan();
  }

  #plan() {
    if (!this.isPlanned && this.waiting.size) {
      this.isPlanned = true;
      requestAnimationFrame(() => this.#work());
    }
  }

  #work() {
    const end = performance.now() + MILLISECONDS_PER_FRAME;
    for (const canvas of this.waiting) {
      this.waiting.delete(canvas);
      this.#draw(canvas);
      if (performance.now() > end) break;
    }
    this.isPlanned = false;
    this.#plan();
  }

  #draw(canvas) {
    const shape = Number(canvas.dataset.shape);
    if (!this.stage || !this.shapes[shape].surface) return;
    let picture = this.drawn.get(shape);
    if (!picture) {
      this.stage.show(this.shapes[shape]);
      this.stage.draw();
      picture = this.source;
      this.drawn.set(shape, canvas);
    }
    canvas.width = canvas.height = this.size;
    canvas.getContext("2d").drawImage(picture, 0, 0);
    if (picture === this.source) writeSides(canvas, this.stage.sides());
    canvas.classList.add("drawn");
    this.watcher.unobserve(canvas);
  }
}

// A body that can be rotated with the mouse, a finger or the arrow keys.
class Turntable {
  // `letters` are four elements at the left, right, lower and upper edge.
  constructor(canvas, letters) {
    this.canvas = canvas;
    this.letters = letters;
    this.stage = stageOn(canvas);
    if (!this.stage) return;
    this.controls = new THREE.OrbitControls(this.stage.camera, canvas);
    this.controls.enablePan = false;
    this.controls.addEventListener("change", () => this.#draw());
    canvas.addEventListener("keydown", (event) => this.#pressed(event));
    new ResizeObserver(() => this.#fit()).observe(canvas);
  }

  show(shape) {
    this.canvas.hidden = !this.stage || !shape.surface;
    this.letters.forEach((letter) => (letter.textContent = ""));
    if (this.canvas.hidden) return;
    this.stage.show(shape);
    this.controls.minDistance = 0.4 * this.stage.distance;
    this.controls.maxDistance = 2 * this.stage.distance;
    this.controls.target.set(0, 0, 0);
    this.controls.update();
    this.#fit();
    this.controls.saveState();
  }

  #fit() {
    const { clientWidth, clientHeight } = this.canvas;
    if (!clientWidth || !clientHeight) return;
    this.stage.renderer.setPixelRatio(Math.min(2, window.devicePixelRatio));
    this.stage.renderer.setSize(clientWidth, clientHeight, false);
    this.stage.camera.aspect = clientWidth / clientHeight;
    // In a narrow frame, the body must fit the width
    this.stage.camera.zoom = Math.min(1, this.stage.camera.aspect);
    this.stage.camera.updateProjectionMatrix();
    this.#draw();
  }

  #draw() {
    this.stage.draw();
    const sides = this.stage.sides();
    this.letters.forEach((letter, i) => (letter.textContent = sides[i] ?? ""));
  }

  #pressed(event) {
    const step = Math.PI / 18;
    const actions = {
      ArrowLeft: () => this.controls.rotateLeft(step),
      ArrowRight: () => this.controls.rotateLeft(-step),
      ArrowUp: () => this.controls.rotateUp(step),
      ArrowDown: () => this.controls.rotateUp(-step),
      "+": () => this.controls.dollyIn(0.9),
      "-": () => this.controls.dollyIn(1 / 0.9),
      Home: () => this.controls.reset(),
    };
    if (!actions[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation(); // elsewhere, the arrow keys lead to other shapes
    actions[event.key]();
  }
}

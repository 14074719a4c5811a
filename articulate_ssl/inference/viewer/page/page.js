// Shows the scene that `html_page.py` wrote into this page (see `describe` there for its fields), and moves its joints.
// Matrices of the scene are lists of rows that act on column vectors; three.js computes with them in double precision.

import * as THREE from "three";
import { OrbitControls } from "orbit-controls";

const REVOLUTE = "revolute";
const FIELD_OF_VIEW = 35, HALF_VIEW = THREE.MathUtils.degToRad(FIELD_OF_VIEW / 2);
const FIRST_AZIMUTH = THREE.MathUtils.degToRad(32), FIRST_ELEVATION = THREE.MathUtils.degToRad(24);
// Shares of the object's size, chosen by eye: of a point if there were one only, at most, and of an arrow.
const POINT_SIZE = 0.6, LARGEST_POINT = 0.016, SHAFT_RADIUS = 0.007;

const scene = JSON.parse(document.getElementById("scene").textContent);
const element = (id) => document.getElementById(id);
const colours = getComputedStyle(document.documentElement);

// ---- the object -----------------------------------------------------------------------------------------------------

function decode(Type, base64) {
  return new Type(Uint8Array.from(atob(base64), (c) => c.charCodeAt(0)).buffer);
}

function matrix(rows) {
  return new THREE.Matrix4().set(...rows.flat());
}

/** The joint's own motion of canonical object space: `geometry.screw.screw_motion`. */
function jointMotion(joint, state) {
  const axis = new THREE.Vector3(...joint.axis), motion = new THREE.Matrix4();
  if (joint.kind !== REVOLUTE) return motion.setPosition(axis.multiplyScalar(state));
  const pivot = new THREE.Vector3(...joint.pivot);
  motion.makeRotationAxis(axis.normalize(), state);
  return motion.setPosition(pivot.clone().sub(pivot.clone().applyMatrix4(motion)));
}

/** Every part's pose, canonical object space -> scan: a part's motion is its parent's times its own joint's. */
function partPoses(hypothesis, states) {
  const jointOf = new Map(hypothesis.joints.map((joint, j) => [joint.child, j])), poses = new Map();
  function poseOf(part) {
    if (!poses.has(part)) {
      const j = jointOf.get(part);
      poses.set(part, j === undefined ? matrix(hypothesis.basePose)
        : poseOf(hypothesis.joints[j].parent).clone().multiply(jointMotion(hypothesis.joints[j], states[j])));
    }
    return poses.get(part);
  }
  return hypothesis.parts.map((_, part) => poseOf(part));
}

// ---- what is drawn --------------------------------------------------------------------------------------------------

function placed(object, pose) {
  object.matrixAutoUpdate = false;
  object.matrix.copy(pose);
  object.matrixWorldNeedsUpdate = true;
  return object;
}

function discTexture() {
  const canvas = document.createElement("canvas"), side = 64;
  canvas.width = canvas.height = side;
  const context = canvas.getContext("2d");
  context.fillStyle = "white";
  context.arc(side / 2, side / 2, side / 2 - 1, 0, 2 * Math.PI);
  context.fill();
  return new THREE.CanvasTexture(canvas);
}

function cloudOf(hypothesis) {
  const partOf = decode(Uint8Array, hypothesis.partOfPoint), colour = new THREE.Color();
  const painted = new Float32Array(3 * partOf.length);
  partOf.forEach((part, i) => {
    // Darker than the surfaces, which the points lie on.
    colour.setRGB(...hypothesis.parts[part].colour, THREE.SRGBColorSpace).multiplyScalar(0.45).toArray(painted, 3 * i);
  });
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(decode(Float32Array, scene.points), 3));
  geometry.setAttribute("color", new THREE.BufferAttribute(painted, 3));
  // three.js takes the field of view for a right angle.
  const size = Math.min(POINT_SIZE / Math.sqrt(partOf.length), LARGEST_POINT) / Math.tan(HALF_VIEW);
  const material = new THREE.PointsMaterial({ size, vertexColors: true, map: discTexture(), alphaTest: 0.5 });
  return new THREE.Points(geometry, material);
}

function meshOf(part) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(decode(Float32Array, part.vertices), 3));
  geometry.setAttribute("normal", new THREE.BufferAttribute(decode(Float32Array, part.normals), 3));
  geometry.setIndex(new THREE.BufferAttribute(decode(Uint32Array, part.faces), 1));
  const colour = new THREE.Color().setRGB(...part.colour, THREE.SRGBColorSpace);
  // Pushed back a little, so that points on a surface are not half buried in it.
  return new THREE.Mesh(geometry, new THREE.MeshStandardMaterial({
    color: colour, roughness: 0.62, polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 8,
  }));
}

function arrowOf([tail, middle, tip]) {
  const from = new THREE.Vector3(...tail), to = new THREE.Vector3(...tip);
  const length = from.distanceTo(to), radius = SHAFT_RADIUS * scene.scale, head = Math.min(6 * radius, 0.4 * length);
  const material = new THREE.MeshBasicMaterial({ color: colours.getPropertyValue("--ink"), depthTest: false });
  const shaft = new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, length - head, 20), material);
  const cone = new THREE.Mesh(new THREE.ConeGeometry(2.6 * radius, head, 24), material);
  const knob = new THREE.Mesh(new THREE.SphereGeometry(1.7 * radius, 20, 14), material);
  shaft.position.y = (length - head) / 2;
  cone.position.y = length - head / 2;
  knob.position.y = from.distanceTo(new THREE.Vector3(...middle));
  const arrow = new THREE.Group().add(shaft, cone, knob);
  arrow.children.forEach((mesh) => { mesh.renderOrder = 1; });  // seen through the parts
  arrow.position.copy(from);
  arrow.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), to.sub(from).normalize());
  return new THREE.Group().add(arrow);
}

/** Nodes of one hypothesis, all in the frame of the scan. */
function nodesOf(hypothesis) {
  const toScan = new THREE.Matrix4().makeScale(scene.scale, scene.scale, scene.scale).setPosition(...scene.center);
  const nodes = {
    cloud: placed(cloudOf(hypothesis), toScan),
    meshes: hypothesis.parts.map(meshOf),
    axes: hypothesis.joints.map((joint) => arrowOf(joint.arrow)),
    all: new THREE.Group(),
  };
  nodes.all.add(nodes.cloud, ...nodes.meshes, ...nodes.axes);
  return nodes;
}

const world = new THREE.Scene(), camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 100);
// Display: right, up, front, near the origin and about one unit large. In doubles, so that far-off scans do not jitter.
const display = matrix(scene.level.map((row) => [...row, 0]).concat([[0, 0, 0, 1]]))
  .multiply(new THREE.Matrix4().makeScale(1 / scene.scale, 1 / scene.scale, 1 / scene.scale))
  .multiply(new THREE.Matrix4().makeTranslation(...scene.center.map((x) => -x)));
const frame = placed(new THREE.Group(), display);
const hypotheses = scene.hypotheses.map((hypothesis) => ({ ...hypothesis, ...nodesOf(hypothesis) }));
hypotheses.forEach((hypothesis) => { hypothesis.states = hypothesis.joints.map((joint) => joint.state); });
frame.add(...hypotheses.map((hypothesis) => hypothesis.all));
const lamp = new THREE.DirectionalLight(0xffffff, 2.3);
lamp.position.set(-0.6, 1.1, 0.9);
camera.add(lamp);
world.add(frame, camera, new THREE.HemisphereLight(0xffffff, 0x8a93a0, 1.5));

let shown = hypotheses[0], renderer = null, controls = null;

function move(hypothesis) {
  const poses = partPoses(hypothesis, hypothesis.states);
  hypothesis.meshes.forEach((node, part) => placed(node, poses[part]));
  hypothesis.axes.forEach((node, j) => placed(node, poses[hypothesis.joints[j].parent]));
}

function draw() {
  for (const hypothesis of hypotheses) {
    hypothesis.all.visible = hypothesis === shown;
    hypothesis.cloud.visible = element("show-scan").checked;
    hypothesis.meshes.forEach((node) => { node.visible = element("show-reconstruction").checked; });
    hypothesis.axes.forEach((node) => { node.visible = element("show-axes").checked; });
  }
  renderer?.render(world, camera);
}

/** The least sphere about the middle of all that is shown, with the joints as scanned and at both ends. */
function boundingSphere() {
  const box = new THREE.Box3(), points = [], kept = shown.states;
  for (const end of ["state", "lower", "upper"]) {
    shown.states = shown.joints.map((joint) => joint[end]);
    move(shown);
    frame.updateMatrixWorld(true);
    for (const node of [shown.cloud, ...shown.meshes]) {
      const position = node.geometry.getAttribute("position");
      for (let i = 0; i < position.count; i++) {
        points.push(new THREE.Vector3().fromBufferAttribute(position, i).applyMatrix4(node.matrixWorld));
        box.expandByPoint(points.at(-1));
      }
    }
  }
  shown.states = kept;
  move(shown);
  const center = box.getCenter(new THREE.Vector3());
  return new THREE.Sphere(center, Math.max(...points.map((point) => point.distanceTo(center))));
}

function resetView() {
  const { center, radius } = boundingSphere(), level = Math.cos(FIRST_ELEVATION);
  const distance = radius / Math.sin(Math.atan(Math.min(1, camera.aspect) * Math.tan(HALF_VIEW)));
  camera.position.set(Math.sin(FIRST_AZIMUTH) * level, Math.sin(FIRST_ELEVATION), Math.cos(FIRST_AZIMUTH) * level)
    .multiplyScalar(distance).add(center);
  camera.near = distance / 100;
  camera.far = distance * 100;
  camera.lookAt(center);
  camera.updateProjectionMatrix();
  controls?.target.copy(center);
  controls?.update();
  draw();
}

// ---- controls -------------------------------------------------------------------------------------------------------

/** Degrees, or a length with as many decimals as tell a thousandth of the joint's range. */
function text(joint, state) {
  const decimals = Math.ceil(Math.log10(1000 / (joint.upper - joint.lower)));
  const number = joint.kind === REVOLUTE ? `${THREE.MathUtils.radToDeg(state).toFixed(1)}°`
    : state.toFixed(THREE.MathUtils.clamp(decimals, 0, 20));
  return number.replace("-", "\u2212");
}

function make(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function sliderOf(hypothesis, j) {
  const joint = hypothesis.joints[j], value = make("output", { textContent: text(joint, hypothesis.states[j]) });
  const swatch = make("span", { className: "swatch" });
  swatch.style.background = `rgb(${hypothesis.parts[joint.child].colour.map((c) => 255 * c).join(" ")})`;
  const range = make("input", { type: "range", min: joint.lower, max: joint.upper, step: "any", id: `slider-${j}` });
  range.value = hypothesis.states[j];
  range.setAttribute("aria-label", `State of ${joint.name}`);
  range.addEventListener("input", () => {
    hypothesis.states[j] = range.valueAsNumber;
    value.textContent = text(joint, hypothesis.states[j]);
    move(hypothesis);
    draw();
  });
  const does = joint.kind === REVOLUTE ? "turns" : "slides";
  return make("div", { className: "joint" },
    make("div", { className: "name" }, swatch, make("span", { textContent: joint.name.replace("_", " ") }), value),
    range,
    make("div", { className: "ends" }, make("span", { textContent: text(joint, joint.lower) }),
      make("span", { textContent: `part ${joint.child} ${does} on part ${joint.parent}` }),
      make("span", { textContent: text(joint, joint.upper) })));
}

function show(index) {
  shown = hypotheses[index];
  element("sliders").replaceChildren(...shown.joints.map((_, j) => sliderOf(shown, j)));
  element("joints").hidden = shown.joints.length === 0;
  move(shown);
  draw();
}

function fillPanel() {
  const count = (n, word) => `${n.toLocaleString("en")} ${word}${n === 1 ? "" : "s"}`;
  element("category").textContent = scene.category.replaceAll("_", " ");
  element("summary").textContent = [count(hypotheses[0].meshes.length, "part"), count(hypotheses[0].joints.length, "joint"),
    count(scene.numPoints, "point")].join(" · ");
  element("warning").textContent = scene.warning;
  element("warning").hidden = !scene.warning;
  hypotheses.forEach((hypothesis, i) => {
    const radio = make("input", { type: "radio", name: "hypothesis", id: `hypothesis-${i}`, checked: i === 0 });
    radio.addEventListener("change", () => show(i));
    const title = hypothesis.title[0].toUpperCase() + hypothesis.title.slice(1);
    element("hypotheses").append(make("label", {}, radio, make("span", {}, make("span", { textContent: title }),
      make("span", { className: "confidence", textContent: hypothesis.confidence }))));
  });
  for (const id of ["show-scan", "show-reconstruction", "show-axes"]) element(id).addEventListener("change", draw);
  element("reset-view").addEventListener("click", resetView);
  element("reset-states").addEventListener("click", () => {
    shown.states = shown.joints.map((joint) => joint.state);
    show(hypotheses.indexOf(shown));
  });
}

function fit() {
  const { clientWidth: width, clientHeight: height } = element("view");
  camera.aspect = width / Math.max(height, 1);
  camera.updateProjectionMatrix();
  renderer?.setSize(width, height);
  draw();
}

function start() {
  fillPanel();
  show(0);
  try {
    renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
  } catch {
    element("failure").textContent = "This browser cannot draw in 3D: WebGL is missing or turned off.";
    element("failure").hidden = false;
    return;
  }
  renderer.setPixelRatio(window.devicePixelRatio);
  element("view").append(renderer.domElement);
  controls = new OrbitControls(camera, renderer.domElement);
  controls.addEventListener("change", draw);
  new ResizeObserver(fit).observe(element("view"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    const ink = colours.getPropertyValue("--ink");
    hypotheses.forEach((hypothesis) => hypothesis.axes.forEach((axis) => axis.traverse((node) => node.material?.color.set(ink))));
    draw();
  });
  fit();
  resetView();
}

start();

// For tests and scripts: what is shown now, as lists of rows, canonical object space -> scan.
window.articulated = {
  states: () => [...shown.states],
  transforms: () => shown.meshes.map((node) => {
    const rows = node.matrix.clone().transpose().elements;
    return [0, 4, 8, 12].map((i) => rows.slice(i, i + 4));
  }),
};

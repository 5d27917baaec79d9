"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
const floats = (text) => new Float32Array(bytes(text)), whole = (text) => new Uint32Array(bytes(text));
const element = (id) => document.getElementById(id);
const UNKNOWN = 1e30;

// The eye: rows of `turn` are right, up and towards the viewer; `shift` and `zoom` are in units of the radius.
const eye = { turn: data.view.slice(), shift: [0, 0], zoom: 1, place: -1 };
const home = () => Object.assign(eye, { turn: data.view.slice(), shift: [0, 0], zoom: 1, place: -1 });
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((x) => x / n); };

function turnBy(x, y) { // what is in front moves to the right by x, down by y, in radians
  let [right, up, towards] = [0, 3, 6].map((i) => eye.turn.slice(i, i + 3));
  const mix = (a, b, angle) => a.map((v, i) => v * Math.cos(angle) + b[i] * Math.sin(angle));
  [right, towards] = [mix(right, towards, x), mix(towards, right, -x)];
  [up, towards] = [mix(up, towards, -y), mix(towards, up, y)];
  towards = unit(towards);
  right = unit(cross(up, towards));
  eye.turn = [...right, ...cross(towards, right), ...towards];
}

function lookAt(place) {
  const towards = unit(data.places[place].normal), up0 = Math.abs(towards[2]) < 0.8 ? [0, 0, 1] : [0, 1, 0];
  const right = unit(cross(up0, towards)), up = cross(towards, right);
  const away = data.places[place].position.map((x, i) => x - data.centre[i]);
  const shift = [-dot(right, away) / data.radius, -dot(up, away) / data.radius];
  Object.assign(eye, { turn: [...right, ...up, ...towards], shift, zoom: 2.5, place });
}

const VERTEX = `#version 300 es
in vec3 position; in vec3 normal; in float value;
uniform mat3 turn; uniform vec3 centre; uniform vec3 scale; uniform vec2 shift; uniform float size; uniform float nearer;
out vec3 n; out float v;
void main() {
  vec3 p = turn * (position - centre);
  gl_Position = vec4((p.xy + shift) * scale.xy, -p.z * scale.z - nearer, 1.0);
  gl_PointSize = size; n = turn * normal; v = value;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 n; in float v; uniform int map; uniform bool round; uniform float limit; uniform vec3 plain; out vec4 colour;
vec3 stops(float t, vec3 a, vec3 b, vec3 c) { return t < 0.5 ? mix(a, b, 2.0 * t) : mix(b, c, 2.0 * t - 1.0); }
void main() {
  if (round && length(gl_PointCoord - 0.5) > 0.5) discard;
  vec3 c = plain;
  if (map > 0 && v < 1e29) {
    float t = clamp(abs(v) / limit, 0.0, 1.0);
    if (map == 2) c = stops(t, vec3(1.0, 1.0, 0.85), vec3(0.25, 0.71, 0.77), vec3(0.03, 0.11, 0.35));
    else if (v > 0.0) c = stops(t, vec3(0.97), vec3(0.94, 0.54, 0.38), vec3(0.70, 0.09, 0.17));
    else c = stops(t, vec3(0.97), vec3(0.40, 0.66, 0.81), vec3(0.13, 0.40, 0.67));
  }
  float lit = dot(n, n) < 0.01 ? 1.0 : 0.5 + 0.5 * abs(dot(normalize(n), vec3(-0.35, 0.45, 0.82)));
  colour = vec4(c * lit, 1.0);
}`;

function vertexNormals(vertices, triangles) {
  const normals = new Float32Array(vertices.length), at = (i) => vertices.subarray(3 * i, 3 * i + 3);
  for (let t = 0; t < triangles.length; t += 3) {
    const [a, b, c] = [at(triangles[t]), at(triangles[t + 1]), at(triangles[t + 2])];
    const n = cross([b[0] - a[0], b[1] - a[1], b[2] - a[2]], [c[0] - a[0], c[1] - a[1], c[2] - a[2]]);
    for (let k = 0; k < 3; k++) for (let x = 0; x < 3; x++) normals[3 * triangles[t + k] + x] += n[x];
  }
  for (let i = 0; i < normals.length; i += 3) normals.set(unit([...normals.subarray(i, i + 3)]), i);
  return normals;
}

class View {
  constructor(canvas, draw) {
    this.canvas = canvas;
    this.drawAll = draw;
    const gl = this.gl = canvas.getContext("webgl2", { antialias: true });
    if (!gl) throw new Error("no WebGL 2");
    const program = this.program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    ["position", "normal", "value"].forEach((name, i) => gl.bindAttribLocation(program, i, name));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.POLYGON_OFFSET_FILL);
    gl.polygonOffset(1, 1);
  }
  shape(mode, vertices, { rows, normals, value } = {}) {
    const gl = this.gl, shape = { mode, array: gl.createVertexArray(), count: rows ? rows.length : vertices.length / 3 };
    gl.bindVertexArray(shape.array);
    [[vertices, 3], [normals, 3], [value, 1]].forEach(([values, width], i) => {
      if (!values) return;
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, values.map((x) => (Number.isNaN(x) ? UNKNOWN : x)), gl.STATIC_DRAW);
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, width, gl.FLOAT, false, 0, 0);
    });
    if (rows) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, rows, gl.STATIC_DRAW);
      shape.indexed = true;
    }
    return shape;
  }
  draw(shape, { map = 0, limit = 1, plain = [0.82, 0.8, 0.77], size = 1, nearer = 0, first = 0, count = shape.count } = {}) {
    const gl = this.gl, at = (name) => gl.getUniformLocation(this.program, name);
    gl.uniform1i(at("map"), map);
    gl.uniform1i(at("round"), shape.mode === gl.POINTS ? 1 : 0);
    gl.uniform1f(at("limit"), limit);
    gl.uniform3fv(at("plain"), plain);
    gl.uniform1f(at("size"), size * (window.devicePixelRatio || 1));
    gl.uniform1f(at("nearer"), nearer);
    gl.bindVertexArray(shape.array);
    if (shape.indexed) gl.drawElements(shape.mode, count, gl.UNSIGNED_INT, 4 * first);
    else gl.drawArrays(shape.mode, first, count);
  }
  show() {
    const { gl, canvas } = this, ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio].map(Math.round);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clearColor(1, 1, 1, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const at = (name) => gl.getUniformLocation(this.program, name), least = Math.min(width, height);
    const zoom = eye.zoom / (1.05 * data.radius);
    gl.uniformMatrix3fv(at("turn"), true, eye.turn);
    gl.uniform3fv(at("centre"), data.centre);
    gl.uniform3f(at("scale"), (zoom * least) / width, (zoom * least) / height, 0.45 / data.radius);
    gl.uniform2f(at("shift"), eye.shift[0] * data.radius, eye.shift[1] * data.radius);
    this.drawAll(this);
  }
}

function followHand(canvas) {
  const hands = new Map();
  const spread = () => { const [a, b] = [...hands.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };
  const move = (x, y) => {
    const unitsAPixel = (2 * 1.05) / (eye.zoom * Math.min(canvas.clientWidth, canvas.clientHeight));
    eye.shift = [eye.shift[0] + x * unitsAPixel, eye.shift[1] - y * unitsAPixel];
  };
  const zoomBy = (factor) => { eye.zoom = Math.min(Math.max(eye.zoom * factor, 0.2), 100); };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    hands.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const hand = hands.get(event.pointerId);
    if (!hand) return;
    const [x, y] = [event.clientX - hand.x, event.clientY - hand.y], before = hands.size === 2 ? spread() : 1;
    Object.assign(hand, { x: event.clientX, y: event.clientY });
    if (hands.size === 2) {
      zoomBy(spread() / (before || 1));
      move(x / 2, y / 2);
    } else if (event.shiftKey || event.buttons & 6) move(x, y);
    else turnBy(x / 150, y / 150);
    refresh();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => hands.delete(e.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", () => { home(); refresh(); });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomBy(Math.exp(-event.deltaY / 500));
    refresh();
  }, { passive: false });
  const keys = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] };
  canvas.addEventListener("keydown", (event) => {
    if (keys[event.key]) turnBy(...keys[event.key]);
    else if (event.key === "+" || event.key === "-") zoomBy(event.key === "+" ? 1.2 : 1 / 1.2);
    else return;
    event.preventDefault();
    refresh();
  });
}

let views = [], asked = false;
function refresh() {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => { asked = false; views.forEach((view) => view.show()); });
}

const MAPS = {
  distance: [1, "#2166ac, #67a9cf, #f7f7f7, #ef8a62, #b2182b", (x) => [-x, -x / 2, 0, x / 2, x]],
  deviation: [2, "#ffffd9, #40b5c4, #081d59", (x) => [0, x / 2, x]],
};
const chosen = () => document.querySelector("input[name=colour]:checked").value;
function showBar() {
  const name = chosen(), [, colours, ticks] = MAPS[name];
  element("bar").style.background = `linear-gradient(to right, ${colours})`;
  const words = ticks(data[name].limit).map((x) => (name === "distance" && x > 0 ? "+" : "") + x.toPrecision(2));
  element("ticks").replaceChildren(...words.map((word, i) => {
    const tick = document.createElement("span");
    tick.textContent = word + (i === words.length - 1 ? " mm" : "");
    return tick;
  }));
}

function begin() {
  const gl = WebGL2RenderingContext, vertices = floats(data.surface.vertices), rows = whole(data.surface.triangles);
  const normals = vertexNormals(vertices, rows), shapes = {};
  const left = new View(element("surface"), (view) => {
    const name = chosen();
    view.draw(shapes[name], { map: MAPS[name][0], limit: data[name].limit });
    if (element("points").checked) view.draw(shapes.points, { map: 1, limit: data.distance.limit, size: 3, nearer: 0.002, plain: [0.2, 0.2, 0.2] });
    view.draw(shapes.places, { size: 7, nearer: 0.01, plain: [0.1, 0.1, 0.1] });
    if (eye.place >= 0) view.draw(shapes.places, { size: 14, nearer: 0.02, plain: [1, 0.65, 0], first: eye.place, count: 1 });
  });
  for (const name of ["distance", "deviation"]) {
    if (data[name]) shapes[name] = left.shape(gl.TRIANGLES, vertices, { rows, normals, value: floats(data[name].values) });
  }
  shapes.points = left.shape(gl.POINTS, floats(data.points.vertices), { value: floats(data.points.values) });
  shapes.places = left.shape(gl.POINTS, new Float32Array(data.places.flatMap((place) => place.position)));
  const right = new View(element("control"), (view) => {
    view.draw(shapes.faces, { plain: [0.93, 0.92, 0.9] });
    view.draw(shapes.edges, { plain: [0.25, 0.25, 0.25], nearer: 0.004 });
    if (element("start")?.checked) view.draw(shapes.start, { plain: [0.9, 0.45, 0.05], nearer: 0.002 });
  });
  const control = floats(data.control.vertices), faces = whole(data.control.triangles), edges = whole(data.control.edges);
  shapes.faces = right.shape(gl.TRIANGLES, control, { rows: faces, normals: vertexNormals(control, faces) });
  shapes.edges = right.shape(gl.LINES, control, { rows: edges });
  if (data.start) shapes.start = right.shape(gl.LINES, floats(data.start), { rows: edges });
  views = [left, right];
  views.forEach((view) => followHand(view.canvas));
  document.querySelectorAll("input").forEach((input) => input.addEventListener("change", () => { showBar(); refresh(); }));
  document.querySelectorAll("button[data-place]").forEach((button) => button.addEventListener("click", () => {
    lookAt(Number(button.dataset.place));
    element("surface").scrollIntoView({ behavior: "smooth", block: "center" });
    refresh();
  }));
  window.addEventListener("resize", refresh);
  showBar();
  refresh();
}

try {
  begin();
} catch (error) {
  for (const id of ["surface", "control"]) {
    const note = document.createElement("p");
    note.textContent = `The 3D view cannot be shown: ${error.message}.`;
    element(id).replaceWith(note);
  }
}

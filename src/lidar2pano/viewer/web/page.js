"use strict";
(() => {
const INDEX = JSON.parse(document.getElementById("index").textContent);
const LAYERS = ["colour", "classes", "depth", "camera", "confidence", "source"];
const UNITS = { colour: 0, classes: 1, depth: 2, camera: 3, confidence: 4, source: 5, table: 6 };
const COLOURINGS = { layer: -1, classes: 1, height: 10, intensity: 11, distance: 12 };  // of points, as the shader knows them
const FIRST_FOV = 55;                     // degrees, at least, of the first view: about that of a camera
const ROUND_S = 60;                       // of a slow turn all around
const JUMPS = 8, JUMP_S = 3;              // the same where the system wishes for little motion: so many directions, so long each
const GRID_M = 10, GRID_LINES = 10;       // spacing; lines to either side of the middle
const TURN = 2 * Math.PI, RAD = Math.PI / 180;
const $ = (id) => document.getElementById(id);
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const mod = (value, by) => ((value % by) + by) % by;

const state = {
  yaw: 0, pitch: null, fov: null,         // radians; fov is horizontal. null: the whole height of the panorama
  layer: "colour", compare: false, split: 0.5,
  frame: 0, playing: false, loop: true,
  revolving: null,                        // the slow turn that goes on
  cloud: false, orbit: null, colouring: "layer", pointSize: 1,   // orbit null: all points are in sight
  chosen: new Set(),                      // classes to show; none: all
};
let frame = null;                         // what is shown: { info, bitmaps, points }
let gl, canvas, programs, textures = {}, cloudBuffer, intensityBuffer, gridBuffer, cloudCount = 0, gridCount = 0, mostTexels = 0;

// --- data -------------------------------------------------------------------------------------------------------------

function bytesOf(id) {
  const text = $(id).textContent;
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

async function bitmapOf([id, type], smooth) {
  const blob = new Blob([bytesOf(id)], { type });
  const exact = { premultiplyAlpha: "none", colorSpaceConversion: "none" };
  const bitmap = await createImageBitmap(blob, exact);
  let { width, height } = bitmap;
  if (Math.max(width, height) <= mostTexels) return bitmap;
  while (Math.max(width, height) > mostTexels) { width = width >> 1; height = height >> 1; }
  const resized = { resizeWidth: width, resizeHeight: height, resizeQuality: smooth ? "high" : "pixelated" };
  const smaller = await createImageBitmap(bitmap, { ...exact, ...resized });
  bitmap.close();
  return smaller;
}

// Points are stored as planes of the low and the high bytes of x, y and z, each the difference from the point before.
async function inflated(id) {
  const stream = new Blob([bytesOf(id)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

async function pointsOf([id, count, , intensity]) {
  const planes = await inflated(id);
  const xyz = new Int16Array(count * 3);
  for (let axis = 0; axis < 3; axis++) {
    const low = 2 * axis * count, high = low + count;
    for (let i = 0, value = 0; i < count; i++) {
      value += planes[low + i] | (planes[high + i] << 8);
      xyz[3 * i + axis] = value;
    }
  }
  return { xyz, intensity: intensity ? await inflated(intensity) : null, box: boxOf(xyz) };
}

const cache = new Map();                  // frame number -> promise of its decoded data; the last few frames

function decoded(number) {
  if (!cache.has(number)) {
    const info = INDEX.frames[number];
    const names = LAYERS.filter((name) => info.layers[name]);
    const bitmaps = names.map((name) => bitmapOf(info.layers[name], name === "colour" || name === "camera"));
    cache.set(number, Promise.all([Promise.all(bitmaps), info.points ? pointsOf(info.points) : null]).then(
      ([found, points]) => ({ number, info, points, bitmaps: Object.fromEntries(names.map((n, i) => [n, found[i]])) })));
    const [oldest] = cache.keys();
    if (cache.size > 8 && oldest !== frame?.number) {
      cache.get(oldest).then((old) => Object.values(old.bitmaps).forEach((bitmap) => bitmap.close()), () => {});
      cache.delete(oldest);
    }
  }
  return cache.get(number);
}

async function show(number) {
  state.frame = number;
  const next = await decoded(number);
  if (state.frame !== number) return;     // another one has been chosen meanwhile
  frame = next;
  upload();
  if (!frame.info.layers[state.layer]) state.layer = "colour";
  update();
  if (state.playing) decoded((number + 1) % INDEX.frames.length);
}

// --- WebGL ------------------------------------------------------------------------------------------------------------

function program(vertices, fragments) {
  const made = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertices], [gl.FRAGMENT_SHADER, fragments]]) {
    const shader = gl.createShader(type);
    const [factor, metres] = INDEX.occluded.map((value) => value.toFixed(3));
    gl.shaderSource(shader, source.replace("OCCLUDED", `metres * ${factor} + ${metres}`));
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const places = new Map();
  const at = (name) => places.get(name) ?? places.set(name, gl.getUniformLocation(made, name)).get(name);
  gl.useProgram(made);
  for (const [name, unit] of Object.entries(UNITS)) gl.uniform1i(at(name === "camera" ? "photo" : name), unit);
  return { made, at };
}

function texture(unit, { smooth = false, circular = true } = {}) {
  const made = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, circular ? gl.REPEAT : gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, smooth ? gl.LINEAR : gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, smooth ? gl.LINEAR_MIPMAP_LINEAR : gl.NEAREST);
  return made;
}

function start() {
  canvas = $("canvas");
  gl = canvas.getContext("webgl2", { alpha: false, antialias: false });
  if (!gl) throw new Error("this page needs WebGL 2; switch on hardware acceleration, or use another browser");
  mostTexels = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
  gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
  programs = {
    look: program(TRIANGLE, LOOK), map: program(TRIANGLE, MAP), cloud: program(CLOUD_VERTICES, CLOUD_PIXELS),
    grid: program(GRID_VERTICES, GRID_PIXELS),
  };
  texture(UNITS.table, { circular: false });
  const table = new Uint8Array(256 * 4 * 4);
  INDEX.classes.forEach(({ colour }, id) => table.set([...colour, 255], 4 * id));
  INDEX.depth.colours.forEach((colour, step) => table.set([...colour, 255], 4 * (256 + step)));
  INDEX.confidence.colours.forEach((colour, step) => table.set([...colour, 255], 4 * (512 + step)));
  INDEX.sources.forEach(({ colour }, number) => table.set([...colour, 255], 4 * (768 + number)));
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 4, 0, gl.RGBA, gl.UNSIGNED_BYTE, table);
  [cloudBuffer, intensityBuffer, gridBuffer] = [0, 1, 2].map(() => gl.createBuffer());
  canvas.addEventListener("webglcontextlost", () => setTimeout(() => location.reload(), 500));
}

function upload() {
  const circular = Math.abs(frame.info.view[2] - frame.info.view[3] - TURN) < 1e-9;
  for (const name of LAYERS) {
    gl.deleteTexture(textures[name]);
    const smooth = name === "colour" || name === "camera", bitmap = frame.bitmaps[name];
    textures[name] = texture(UNITS[name], { smooth, circular });
    if (bitmap) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
    else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    if (smooth) gl.generateMipmap(gl.TEXTURE_2D);
  }
  cloudCount = frame.points ? frame.points.xyz.length / 3 : 0;
  if (!cloudCount) return;
  const { xyz, intensity, box } = frame.points, reach = GRID_M * GRID_LINES, lines = [];
  const [x, y] = [box.x, box.y].map((value) => GRID_M * Math.round(value / GRID_M));
  for (let i = -reach; i <= reach; i += GRID_M) {
    for (let j = -reach; j < reach; j += GRID_M) {  // in short pieces: not every driver cuts a line that reaches behind the eye
      lines.push(x + i, y + j, box.low, x + i, y + j + GRID_M, box.low, x + j, y + i, box.low, x + j + GRID_M, y + i, box.low);
    }
  }
  gridCount = lines.length / 3;
  for (const [buffer, data] of [[cloudBuffer, xyz], [intensityBuffer, intensity], [gridBuffer, new Float32Array(lines)]]) {
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    if (data) gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
  }
}

// Where the points are, in metres: their middle, the radius of nine tenths of them, the ground and the highest but a few.
function boxOf(xyz) {
  const count = xyz.length / 3, step = Math.max(1, Math.floor(count / 5000)), axes = [[], [], []];
  for (let i = 0; i < count; i += step) axes.forEach((values, axis) => values.push(xyz[3 * i + axis] / 100));
  const at = (values, share) => [...values].sort((a, b) => a - b)[Math.floor(share * (values.length - 1))] ?? 0;
  const [x, y] = axes.map((values) => at(values, 0.5)), low = at(axes[2], 0.1), high = at(axes[2], 0.98);
  const radius = at(axes[0].map((value, i) => Math.hypot(value - x, axes[1][i] - y)), 0.9);
  return { x, y, low, high: Math.max(high, low + 1), radius: Math.max(radius, 1) };
}

function orbitOf() {                      // behind and above, so that nine tenths of the points are in sight
  if (state.orbit) return state.orbit;
  const { x, y, low, radius } = frame.points.box;
  return { yaw: 0, pitch: 0.6, distance: 1.5 * radius, x, y, z: low };
}

// --- geometry of the view: sensor axes, x forward, y left, z up --------------------------------------------------------

const ratio = () => Math.min(window.devicePixelRatio || 1, 2);

function rectangle(element) {             // left, bottom, width, height in pixels of the canvas
  const box = element.getBoundingClientRect(), r = ratio();
  const left = Math.round(box.left * r), bottom = canvas.height - Math.round(box.bottom * r);
  return [left, bottom, Math.round(box.right * r) - left, canvas.height - Math.round(box.top * r) - bottom];
}

function angles() {                       // what is looked at, with defaults and limits: radians, and focal in CSS pixels
  const box = $("view").getBoundingClientRect(), width = Math.max(box.width, 1), height = Math.max(box.height, 1);
  const [up, down] = frame.info.view;
  const whole = 2 * Math.atan(width / 2 / (height / (up - down)));  // the panorama fills the height
  const fov = clamp(state.fov ?? Math.max(whole, FIRST_FOV * RAD), 0.5 * RAD, 150 * RAD);
  const pitch = clamp(state.pitch ?? Math.atan((up + down) / 2), Math.atan(down), Math.atan(up));
  return { yaw: state.yaw, pitch, fov, focal: width / 2 / Math.tan(fov / 2), width, height };
}

function axesOf({ yaw, pitch }) {         // columns: forward, left, up
  const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
  return [cp * cy, cp * sy, sp, -sy, cy, 0, -sp * cy, -sp * sy, cp];
}

function directionAt(x, y) {              // of a place in the window
  const box = $("view").getBoundingClientRect(), look = angles(), m = axesOf(look);
  const [f, l, u] = [look.focal, -(x - box.left - box.width / 2), -(y - box.top - box.height / 2)];
  return [0, 1, 2].map((i) => m[i] * f + m[3 + i] * l + m[6 + i] * u);
}

function placeOf([x, y, z]) {             // as in the shader: (0, 0) is the panorama's top left; null outside
  const [up, down, left, right] = frame.info.view;
  const u = mod(left - Math.atan2(y, x), TURN) / (left - right), v = (up - z / Math.hypot(x, y)) / (up - down);
  return u <= 1 && v >= 0 && v < 1 ? [u, v] : null;
}

function cloudProjection(width, height) { // 4 x 4, column after column
  const { yaw, pitch, distance, x, y, z } = orbitOf();
  const m = axesOf({ yaw, pitch: -pitch }), near = distance / 50, far = 1000, f = 1.4 * Math.min(1, width / height);
  const eye = [x - distance * m[0], y - distance * m[1], z - distance * m[2]];
  const rows = [
    [-m[3], -m[4], -m[5]].map((value) => value * f * height / width), [m[6], m[7], m[8]].map((value) => value * f),
  ];
  const dot = (a) => a[0] * eye[0] + a[1] * eye[1] + a[2] * eye[2], forward = [m[0], m[1], m[2]];
  const A = (far + near) / (far - near), B = -2 * far * near / (far - near);
  return [0, 1, 2].flatMap((i) => [rows[0][i], rows[1][i], A * forward[i], forward[i]])
    .concat([-dot(rows[0]), -dot(rows[1]), -A * dot(forward) + B, -dot(forward)]);
}

// --- drawing ----------------------------------------------------------------------------------------------------------

let ground = [0, 0, 0];                   // colour of the page, 0 to 1
function setGround() {
  ground = getComputedStyle(document.body).backgroundColor.match(/[\d.]+/g).slice(0, 3).map((value) => value / 255);
  redraw();
}

let pending = false;
function redraw() {
  if (!pending) { pending = true; requestAnimationFrame(() => { pending = false; if (frame) draw(); }); }
}

function use({ made, at }, box, detail) {
  const [up, down, left, right] = frame.info.view;
  gl.useProgram(made);
  gl.viewport(...box);
  gl.scissor(...box);
  gl.uniform4f(at("cylinder"), up, down, left, left - right);
  gl.uniform1f(at("detail"), Math.max(detail, 0));
  gl.uniform2f(at("depthRange"), INDEX.depth.nearest, INDEX.depth.farthest);
  gl.uniform4f(at("pane"), ...box);
  gl.uniform3f(at("ground"), ...ground);
  gl.uniform1i(at("chosen"), [...state.chosen].reduce((bits, id) => bits | (1 << id), 0));
  return at;
}

function draw() {
  const r = ratio(), width = Math.round(innerWidth * r), height = Math.round(innerHeight * r);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  gl.disable(gl.SCISSOR_TEST);
  gl.clearColor(...ground, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.SCISSOR_TEST);
  const look = angles(), axes = axesOf(look), layer = LAYERS.indexOf(state.layer);
  const texels = frame.bitmaps.colour.width / (frame.info.view[2] - frame.info.view[3]);  // per radian

  const box = rectangle($("view")), focal = box[2] / 2 / Math.tan(look.fov / 2);
  let at = use(programs.look, box, Math.log2(texels / focal) - 0.25);
  gl.uniformMatrix3fv(at("axes"), false, axes);
  gl.uniform1f(at("focal"), focal);
  gl.uniform1f(at("boundary"), state.compare ? box[0] + Math.round(state.split * box[2]) : -1);
  gl.uniform2i(at("layers"), 0, layer);
  gl.drawArrays(gl.TRIANGLES, 0, 3);

  const map = rectangle($("map"));
  at = use(programs.map, map, Math.log2(frame.bitmaps.colour.width / map[2]) - 0.25);
  gl.uniformMatrix3fv(at("axes"), false, axes);
  gl.uniform3f(at("view"), box[2], box[3], focal);
  gl.uniform1i(at("layer"), layer);
  gl.drawArrays(gl.TRIANGLES, 0, 3);

  if (state.cloud && cloudCount) {
    const pane = rectangle($("points"));
    at = use(programs.cloud, pane, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const projection = cloudProjection(pane[2], pane[3]), { box: { low, high } } = frame.points;
    gl.uniformMatrix4fv(at("projection"), false, projection);
    gl.uniform2f(at("heights"), low, high);
    gl.uniform3f(at("origin"), ...frame.info.origin);
    gl.uniform1f(at("enlarged"), state.pointSize);
    gl.uniform1f(at("size"), 0.12 * pane[3] * Math.max(1, Math.sqrt(frame.info.points[2] / cloudCount) / 2));
    gl.uniform1i(at("layer"), state.colouring === "layer" ? layer : COLOURINGS[state.colouring]);
    gl.bindBuffer(gl.ARRAY_BUFFER, cloudBuffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.SHORT, false, 6, 0);
    if (frame.points.intensity) {
      gl.bindBuffer(gl.ARRAY_BUFFER, intensityBuffer);
      gl.enableVertexAttribArray(1);
      gl.vertexAttribPointer(1, 1, gl.UNSIGNED_BYTE, true, 1, 0);
    }
    gl.enable(gl.DEPTH_TEST);
    gl.drawArrays(gl.POINTS, 0, cloudCount);
    gl.disableVertexAttribArray(1);
    gl.useProgram(programs.grid.made);
    gl.uniformMatrix4fv(programs.grid.at("projection"), false, projection);
    gl.uniform3f(programs.grid.at("line"), ...ground.map((value) => 0.75 * value + 0.125));
    gl.bindBuffer(gl.ARRAY_BUFFER, gridBuffer);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 12, 0);
    gl.drawArrays(gl.LINES, 0, gridCount);
    gl.disable(gl.DEPTH_TEST);
    gl.disableVertexAttribArray(0);
  }
}

// --- what stands around the panes -------------------------------------------------------------------------------------

function element(name, properties, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function swatch([r, g, b]) {
  const made = element("i");
  made.style.background = `rgb(${r} ${g} ${b})`;
  return made;
}

function legend() {
  if (state.layer === "classes") {
    return INDEX.classes.flatMap(({ name, colour, present }, id) => {
      if (!present) return [];
      const entry = element("button", { type: "button", title: "Show this class only, or one more" }, swatch(colour), name);
      entry.setAttribute("aria-pressed", state.chosen.has(id));
      entry.addEventListener("click", () => {
        if (!state.chosen.delete(id)) state.chosen.add(id);
        entry.setAttribute("aria-pressed", state.chosen.has(id));
        redraw();
      });
      return [entry];
    });
  }
  if (state.layer === "source") {
    return INDEX.sources.map(({ name, colour }) => element("span", { className: "entry" }, swatch(colour), name));
  }
  const { nearest, farthest } = INDEX.depth, quarters = [0, 1, 2, 3, 4];
  if (state.layer === "depth") {
    const metres = quarters.map((i) => `${Math.round(nearest * (farthest / nearest) ** (i / 4))} m`);
    return ramp(INDEX.depth.colours.slice(1), metres);
  }
  return state.layer === "confidence" ? ramp(INDEX.confidence.colours, quarters.map((i) => `${25 * i} %`)) : [];
}

function ramp(colours, ticks) {
  const scale = element("canvas", { width: colours.length, height: 1 }), pen = scale.getContext("2d");
  colours.forEach(([r, g, b], i) => { pen.fillStyle = `rgb(${r} ${g} ${b})`; pen.fillRect(i, 0, 1, 1); });
  const row = element("div", { className: "ticks" }, ...ticks.map((text) => element("span", { textContent: text })));
  return [element("div", { className: "scale" }, scale, row)];
}

let legendOf = null;
function update() {                       // brings all controls up to date with `state` and draws
  const { info } = frame;
  document.querySelectorAll("#layers button").forEach((button) => {
    button.hidden = !info.layers[button.dataset.layer];
    const checked = button.dataset.layer === state.layer;
    button.setAttribute("aria-checked", checked);
    button.tabIndex = checked ? 0 : -1;
  });
  const buttons = [...document.querySelectorAll("#layers button:not([hidden])")];
  buttons.forEach((button, i) => button.classList.toggle("last", i === buttons.length - 1));
  $("compare").hidden = buttons.length < 2;
  $("compare").setAttribute("aria-pressed", state.compare);
  $("divider").hidden = !state.compare;
  $("divider").style.left = `${100 * state.split}%`;
  $("divider").setAttribute("aria-valuenow", Math.round(100 * state.split));
  $("cloud").hidden = !info.points;
  $("cloud").setAttribute("aria-pressed", state.cloud);
  $("points").hidden = !(state.cloud && info.points);
  if (info.points) {
    const [, count, total] = info.points, n = (value) => value.toLocaleString("en");
    const points = count < total ? `${n(count)} of ${n(total)} points` : `${n(total)} points`;
    $("count").textContent = `${points} \u00b7 grid ${GRID_M} m`;
    const { low, high } = frame.points.box, tick = (value) => `${value.toFixed(1)} m`;
    const ends = { height: [tick(low), tick(high)], intensity: ["weak", "strong"] }[state.colouring];
    $("scale").hidden = !ends;
    $("scale").replaceChildren(...(ends ? ramp(INDEX.confidence.colours, ends) : []));
    $("colouring").value = state.colouring;
    $("colouring").querySelector("[value=intensity]").hidden = !frame.points.intensity;
  }
  if (legendOf !== state.layer) { $("legend").replaceChildren(...legend()); legendOf = state.layer; }
  $("legend").hidden = !$("legend").childElementCount;
  const invented = `colours are invented${info.layers.source ? " where no camera sees" : ""}`;
  $("about").replaceChildren(...INDEX.about.map((fact) => `${fact} \u00b7 `), element("strong", { textContent: invented }));
  $("time").hidden = INDEX.frames.length < 2;
  $("frame").max = INDEX.frames.length - 1;
  $("frame").value = state.frame;
  $("name").textContent = `${state.frame + 1} / ${INDEX.frames.length} \u00b7 ${info.name}`;
  $("play").textContent = state.playing ? "\u275A\u275A" : "\u25B6\uFE0E";
  $("play").setAttribute("aria-pressed", state.playing);
  $("loop").setAttribute("aria-pressed", state.loop);
  $("revolve").setAttribute("aria-pressed", Boolean(state.revolving));
  $("direction").setAttribute("aria-live", state.revolving ? "off" : "polite");  // a screen reader would read on and on
  const [rows, columns] = info.size;
  $("map").style.height = `${Math.round(innerWidth * rows / columns)}px`;
  turned();
}

let written = 0;
function turned() {                       // after a change of direction or zoom
  const { yaw, pitch, fov } = angles(), degrees = (angle) => Math.round(angle / RAD * 10) / 10;
  const aside = degrees(mod(yaw + Math.PI, TURN) - Math.PI);
  const words = aside === 0 ? "ahead" : `${Math.abs(aside).toFixed(1)}\u00b0 ${aside > 0 ? "left" : "right"}`;
  $("direction").textContent = `${words} \u00b7 ${Math.round(fov / RAD)}\u00b0 wide`;
  const [x, y] = [Math.sin(fov / 2) * 22, -Math.cos(fov / 2) * 22];
  $("sector").setAttribute("d", `M0 0L${-x} ${y}A22 22 0 0 1 ${x} ${y}z`);
  $("sector").setAttribute("transform", `rotate(${-aside})`);
  $("map").setAttribute("aria-valuenow", Math.round(aside));
  $("map").setAttribute("aria-valuetext", words);
  clearTimeout(written);                  // the address names the view, so that it can be passed on
  written = setTimeout(writeAddress, 700);
  redraw();
}

function writeAddress() {
  const { yaw, pitch, fov } = angles(), degrees = (angle) => Math.round(angle / RAD * 10) / 10;
  const aside = degrees(mod(yaw + Math.PI, TURN) - Math.PI);
  const parts = { yaw: aside, pitch: degrees(pitch), fov: degrees(fov), layer: state.layer, frame: state.frame };
  if (state.compare) parts.compare = Math.round(state.split * 1000) / 1000;
  if (state.cloud) parts.points = 1;
  try { history.replaceState(null, "", `#${new URLSearchParams(parts)}`); } catch { /* refused: too often */ }
}

function readAddress() {
  const parts = new URLSearchParams(location.hash.slice(1));
  const number = (name) => (parts.has(name) && Number.isFinite(+parts.get(name)) ? +parts.get(name) : null);
  if (number("yaw") !== null) state.yaw = number("yaw") * RAD;
  if (number("pitch") !== null) state.pitch = number("pitch") * RAD;
  if (number("fov") !== null) state.fov = number("fov") * RAD;
  if (LAYERS.includes(parts.get("layer"))) state.layer = parts.get("layer");
  state.compare = number("compare") !== null;
  if (state.compare) state.split = clamp(number("compare"), 0, 1);
  state.cloud = number("points") === 1;
  return show(clamp(Math.round(number("frame") ?? state.frame), 0, INDEX.frames.length - 1));
}

// --- what the user does -----------------------------------------------------------------------------------------------

function turn(dx, dy) {                   // by CSS pixels at the middle of the view
  if (dx || dy) stand();
  const look = angles();
  state.yaw = mod(look.yaw + dx / look.focal + Math.PI, TURN) - Math.PI;
  state.pitch = clamp(look.pitch + dy / look.focal, Math.atan(frame.info.view[1]), Math.atan(frame.info.view[0]));
  turned();
}

function zoom(factor, x, y) {             // what is under (x, y) stays there
  const before = x === undefined ? null : directionAt(x, y), look = angles();
  state.fov = clamp(2 * Math.atan(Math.tan(look.fov / 2) * factor), 2 * RAD, 140 * RAD);
  if (before) {
    const after = directionAt(x, y), azimuth = ([a, b]) => Math.atan2(b, a), slope = ([a, b, c]) => Math.atan(c / Math.hypot(a, b));
    state.yaw += azimuth(before) - azimuth(after);
    state.pitch = look.pitch + slope(before) - slope(after);
  }
  turn(0, 0);
}

function choose(layer) {
  if (!frame.info.layers[layer]) return;
  state.layer = layer;
  if (layer === "colour") state.compare = false;
  update();
}

function compare() {
  if ($("compare").hidden) return;
  state.compare = !state.compare;
  if (state.compare && state.layer === "colour") {
    state.layer = ["camera", "classes", "depth"].find((name) => frame.info.layers[name]);
  }
  update();
}

function cloud() { if (frame.info.points) { state.cloud = !state.cloud; update(); } }

function reset() {
  stand();
  Object.assign(state, { yaw: 0, pitch: null, fov: null, orbit: null });
  turned();
}

async function revolve() {
  const course = state.revolving ? null : {}, calm = matchMedia("(prefers-reduced-motion: reduce)");
  state.revolving = course;
  update();
  let before = performance.now();
  while (course && state.revolving === course) {
    const jump = calm.matches;
    await new Promise((done) => (jump ? setTimeout(done, 1000 * JUMP_S) : requestAnimationFrame(done)));
    if (state.revolving !== course) return;
    const now = performance.now(), share = jump ? 1 / JUMPS : (now - before) / 1000 / ROUND_S;
    before = now;
    state.yaw = mod(state.yaw - TURN * share + Math.PI, TURN) - Math.PI;
    turned();
  }
}

function stand() { if (state.revolving) { state.revolving = null; update(); } }

function step(by) { show(mod(state.frame + by, INDEX.frames.length)); }

async function play() {
  if (INDEX.frames.length < 2) return;
  state.playing = !state.playing;
  update();
  while (state.playing) {
    const began = performance.now();
    if (!state.loop && state.frame === INDEX.frames.length - 1) { state.playing = false; update(); return; }
    await show((state.frame + 1) % INDEX.frames.length);
    await new Promise((done) => setTimeout(done, Math.max(0, 1000 / INDEX.rate / $("speed").value - (performance.now() - began))));
  }
}

function help() { if ($("keys").open) $("keys").close(); else $("keys").showModal(); }

// Drags of one pointer, and pinches of two: move(dx, dy, event), pinch(factor, x, y).
function gestures(pane, move, pinch) {
  const held = new Map();
  pane.addEventListener("pointerdown", (event) => {
    if (event.target.closest("#divider, #legend, #cloudtools")) return;
    pane.setPointerCapture(event.pointerId);
    held.set(event.pointerId, event);
    if (held.size === 1) move(0, 0, event);
  });
  pane.addEventListener("pointermove", (event) => {
    const before = held.get(event.pointerId);
    if (!before) return;
    const other = [...held.values()].find((one) => one.pointerId !== event.pointerId);
    if (other) {
      const length = (one) => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY);
      pinch(length(before) / Math.max(length(event), 1), (event.clientX + other.clientX) / 2, (event.clientY + other.clientY) / 2);
    } else move(event.clientX - before.clientX, event.clientY - before.clientY, event);
    held.set(event.pointerId, event);
  });
  for (const end of ["pointerup", "pointercancel"]) pane.addEventListener(end, (event) => held.delete(event.pointerId));
  pane.addEventListener("wheel", (event) => {
    event.preventDefault();
    pinch(Math.exp(clamp(event.deltaY * (event.deltaMode ? 30 : 1), -240, 240) / 700), event.clientX, event.clientY);
  }, { passive: false });
}

function orbit(dx, dy, event) {
  const o = state.orbit ??= orbitOf(), scale = o.distance / $("points").clientHeight;
  if (event.shiftKey || event.buttons & 6) {  // along the ground
    const [c, s] = [Math.cos(o.yaw), Math.sin(o.yaw)];
    o.x += (dy * c + dx * s) * scale; o.y += (dy * s - dx * c) * scale;
  } else {
    o.yaw -= dx * 0.006;
    o.pitch = clamp(o.pitch + dy * 0.006, -0.2, 1.55);
  }
  redraw();
}

function zoomCloud(factor) {
  state.orbit ??= orbitOf();
  state.orbit.distance = clamp(state.orbit.distance * factor, 2, 600);
  redraw();
}

function fit() { state.orbit = null; redraw(); }

function top() { state.orbit = null; state.orbit = { ...orbitOf(), pitch: 1.55 }; redraw(); }

function resize(factor) { state.pointSize = clamp(state.pointSize * factor, 0.25, 8); redraw(); }

// --- what leaves the page ---------------------------------------------------------------------------------------------

function say(text) {                      // for a moment, and to screen readers
  $("tip").replaceChildren(text);
  $("tip").hidden = false;
  Object.assign($("tip").style, { left: "12px", top: `${$("view").getBoundingClientRect().top + 12}px` });
  setTimeout(() => { if ($("tip").textContent === text) $("tip").hidden = true; }, 2500);
}

function fullscreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen?.().catch(() => say("the browser refuses full screen here"));
}

function screenshot() {
  draw();                                 // what was drawn before is gone from the canvas
  const [left, bottom, width, height] = rectangle($("view"));
  const image = element("canvas", { width, height });
  image.getContext("2d").drawImage(canvas, left, canvas.height - bottom - height, width, height, 0, 0, width, height);
  image.toBlob((blob) => {
    const link = element("a", { href: URL.createObjectURL(blob), download: `${frame.info.name}.${state.layer}.view.png` });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    say("the view is saved as an image");
  });
}

async function copyLink() {
  writeAddress();
  try {
    await navigator.clipboard.writeText(location.href);
    say("a link to this view is copied");
  } catch {
    say("copy the address: it is the link to this view");
  }
}

function theme() {
  const dark = getComputedStyle(document.body).backgroundColor.match(/\d+/g)[0] < 128;
  document.documentElement.style.colorScheme = dark ? "light" : "dark";
  setGround();
}

const eye = element("canvas", { width: 1, height: 1 }).getContext("2d", { willReadFrequently: true });
function codeAt(layer, [u, v]) {
  const bitmap = frame.bitmaps[layer];
  if (!bitmap) return null;
  eye.drawImage(bitmap, -Math.floor(u * bitmap.width) % bitmap.width, -Math.floor(v * bitmap.height));
  return eye.getImageData(0, 0, 1, 1).data[0];
}

function hover(event) {
  if (event.pointerType !== "touch") inform(event.buttons ? null : event.clientX, event.clientY);
}

function middle() {
  const box = $("view").getBoundingClientRect();
  inform(box.left + box.width / 2, box.top + box.height / 2);
}

function inform(x, y) {                   // about a place in the window
  const at = frame && x !== null ? placeOf(directionAt(x, y)) : null;
  const parts = [], add = (text) => parts.push(`${parts.length ? " \u00b7 " : ""}${text}`);
  if (at) {
    const id = codeAt("classes", at), steps = codeAt("depth", at), { nearest, farthest } = INDEX.depth;
    if (id !== null && INDEX.classes[id]) parts.push(swatch(INDEX.classes[id].colour), INDEX.classes[id].name);
    if (steps) {
      const metres = nearest * (farthest / nearest) ** ((steps - 1) / 254);
      add(`${metres.toFixed(metres < 20 ? 1 : 0)} m`);
    }
    const share = codeAt("confidence", at);
    const whole = INDEX.confidence.colours.length - 1;
    if (share !== null) add(`class: ${Math.round(100 * share / whole)} %`);
    const number = codeAt("source", at);
    if (number !== null) add(INDEX.sources[number]?.name ?? `camera ${number}`);
  }
  $("tip").hidden = !parts.length;
  $("tip").replaceChildren(...parts);
  $("tip").style.left = `${Math.min(x + 14, innerWidth - $("tip").offsetWidth - 8)}px`;
  $("tip").style.top = `${Math.max(y - 34, 4)}px`;
}

function lookAt(event) {                  // a place in the map
  stand();
  const box = $("map").getBoundingClientRect(), [up, down, left, right] = frame.info.view;
  state.yaw = left - clamp((event.clientX - box.left) / box.width, 0, 1) * (left - right);
  const v = clamp((event.clientY - box.top) / box.height, 0, 1);
  if (state.fov !== null) state.pitch = Math.atan(up - v * (up - down));
  turned();
}

function key(event) {
  if (!frame || event.ctrlKey || event.metaKey || event.altKey || $("keys").open) return;
  const inCloud = document.activeElement === $("points"), onSlider = document.activeElement === $("frame");
  const onDivider = document.activeElement === $("divider"), small = angles().width / 16;
  const arrows = (dx, dy) => () => {
    if (onDivider && dx) { state.split = clamp(state.split - dx / 50, 0, 1); update(); }
    else if (inCloud) orbit(dx * 16, dy * 16, event);
    else turn(dx * small, dy * small);
  };
  const keys = {
    ArrowLeft: arrows(1, 0), ArrowRight: arrows(-1, 0), ArrowUp: arrows(0, 1), ArrowDown: arrows(0, -1),
    "+": () => (inCloud ? zoomCloud(0.8) : zoom(0.8)), "-": () => (inCloud ? zoomCloud(1.25) : zoom(1.25)),
    1: () => choose("colour"), 2: () => choose("classes"), 3: () => choose("depth"), 4: () => choose("camera"),
    5: () => choose("confidence"),
    6: () => choose("source"), 0: fit, 9: top, "[": () => resize(1 / 1.4), "]": () => resize(1.4),
    f: fullscreen, s: screenshot, l: copyLink, t: theme, i: middle, o: repeat,
    c: compare, p: cloud, r: reset, a: revolve, Home: reset, " ": play, ",": () => step(-1), ".": () => step(1), "?": help,
  };
  keys["="] = keys["+"];
  const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (!Object.hasOwn(keys, name)) return;
  if (onSlider && name.startsWith("Arrow")) return;
  if (document.activeElement instanceof HTMLSelectElement) return;
  if (document.activeElement?.closest("#layers") && name.startsWith("Arrow")) {  // as in any group of radio buttons
    const buttons = [...document.querySelectorAll("#layers button:not([hidden])")], by = /Left|Up/.test(name) ? -1 : 1;
    const next = buttons[mod(buttons.indexOf(document.activeElement) + by, buttons.length)];
    choose(next.dataset.layer);
    next.focus();
    event.preventDefault();
    return;
  }
  if (name === " " && document.activeElement instanceof HTMLButtonElement) return;
  event.preventDefault();
  keys[name]();
}

function repeat() { state.loop = !state.loop; update(); }

function tap(pane) {                      // a touch that moves nothing is what hovering is with a mouse
  let start = null;
  pane.addEventListener("pointerdown", (event) => { start = event.pointerType === "touch" && event.isPrimary ? event : null; $("tip").hidden = true; });
  pane.addEventListener("pointerup", (event) => {
    if (start && Math.hypot(event.clientX - start.clientX, event.clientY - start.clientY) < 8) inform(event.clientX, event.clientY);
  });
}

function listen() {
  tap($("view"));
  gestures($("view"), turn, zoom);
  gestures($("points"), orbit, zoomCloud);
  gestures($("map"), (dx, dy, event) => lookAt(event), (factor) => zoom(factor));
  $("view").addEventListener("pointermove", hover);
  $("view").addEventListener("pointerleave", (event) => { if (event.pointerType !== "touch") $("tip").hidden = true; });
  $("colouring").addEventListener("change", () => { state.colouring = $("colouring").value; update(); });
  $("fullscreen").hidden = !document.fullscreenEnabled;
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", setGround);
  $("divider").addEventListener("pointerdown", (event) => $("divider").setPointerCapture(event.pointerId));
  $("divider").addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    const box = $("view").getBoundingClientRect();
    state.split = clamp((event.clientX - box.left) / box.width, 0, 1);
    update();
  });
  document.querySelectorAll("#layers button").forEach((button) => button.addEventListener("click", (event) => {
    choose(button.dataset.layer);
    if (event.detail) $("view").focus();  // by mouse or touch: the arrow keys look around again
  }));
  for (const [id, action] of Object.entries({ compare, cloud, reset, revolve, help, play, fullscreen, screenshot, link: copyLink, theme,
    fit, top, loop: repeat, smaller: () => resize(1 / 1.4), larger: () => resize(1.4), previous: () => step(-1), next: () => step(1) })) {
    $(id).addEventListener("click", action);
  }
  $("frame").addEventListener("input", () => show(+$("frame").value));
  document.addEventListener("keydown", key);
  addEventListener("hashchange", readAddress);
  new ResizeObserver(() => { if (frame) update(); }).observe(document.body);
  new ResizeObserver(redraw).observe($("view"));
}

try {
  start();
  setGround();
  readAddress().then(() => { listen(); document.body.dataset.ready = "true"; }, fail);
} catch (error) {
  fail(error);
}

function fail(error) {
  console.error(error);
  document.body.append(element("div", { className: "failure", role: "alert", textContent: `Cannot show the panorama: ${error.message}.` }));
}
})();

"use strict";
// The map in WebGL: the first n points show the whole map for every n, so that only as many are drawn as time permits.
const data = JSON.parse(document.getElementById("data").textContent);
const canvas = document.getElementById("view"), panel = document.getElementById("panel"), label = document.getElementById("distance");
const gl = canvas.getContext("webgl", { antialias: false, preserveDrawingBuffer: true });
if (!gl) { panel.hidden = false; panel.textContent = "This browser has no WebGL."; throw new Error("no WebGL"); }

// ---- what is shown

const bytes = atob(data.points), raw = new Uint8Array(bytes.length);
for (let i = 0; i < bytes.length; i++) raw[i] = bytes.charCodeAt(i);
const points = new Int16Array(raw.buffer), COUNT = points.length / 3;
const keyframes = data.keyframes.map(k => k.at);
const chords = ok => data.loops.filter(l => l.ok === ok).flatMap(l => [...keyframes[l.from], ...keyframes[l.to]]);
const steps = data.tracks.flatMap(t => t.slice(1).flatMap((p, i) => [...t[i], ...p]));

function buffer(array) {
  const made = gl.createBuffer();
  gl.bindBuffer(gl.ARRAY_BUFFER, made);
  gl.bufferData(gl.ARRAY_BUFFER, array, gl.STATIC_DRAW);
  return { made, count: array.length / 3 };
}
const cloud = buffer(points);
const shown = {
  way: { ...buffer(new Float32Array(steps)), mode: gl.LINES, color: [0.4, 0.85, 0.5, 1] },
  accepted: { ...buffer(new Float32Array(chords(true))), mode: gl.LINES, color: [0.35, 0.65, 1, 1] },
  rejected: { ...buffer(new Float32Array(chords(false))), mode: gl.LINES, color: [1, 0.4, 0.35, 1] },
  keyframes: { ...buffer(new Float32Array(keyframes.flat())), mode: gl.POINTS, color: [1, 0.85, 0.35, 1] },
};
const marks = { made: gl.createBuffer(), count: 0, mode: gl.POINTS, color: [1, 1, 1, 1] };

function program(vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(made, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  }
  gl.bindAttribLocation(made, 0, "p");
  gl.linkProgram(made);
  return { made, of: name => gl.getUniformLocation(made, name) };
}
const dots = program(
  `attribute vec3 p; uniform mat4 m; uniform float scale, size; uniform vec2 heights; varying vec3 color;
   void main() {
     vec3 at = p * scale; gl_Position = m * vec4(at, 1.0); gl_PointSize = size;
     float h = clamp((at.z - heights.x) / (heights.y - heights.x), 0.0, 1.0);
     color = mix(mix(vec3(0.25, 0.35, 0.5), vec3(0.45, 0.7, 0.65), smoothstep(0.0, 0.4, h)), vec3(0.95, 0.9, 0.75), smoothstep(0.4, 1.0, h));
   }`,
  `precision mediump float; varying vec3 color; void main() { gl_FragColor = vec4(color, 1.0); }`);
const plain = program(
  `attribute vec3 p; uniform mat4 m; uniform float size; void main() { gl_Position = m * vec4(p, 1.0); gl_PointSize = size; }`,
  `precision mediump float; uniform vec4 color; void main() { gl_FragColor = color; }`);
const where = { m: dots.of("m"), scale: dots.of("scale"), size: dots.of("size"), heights: dots.of("heights") };
const line = { m: plain.of("m"), size: plain.of("size"), color: plain.of("color") };

// ---- the eye (the viewpoint): it looks at `target` from a distance of `distance` m, rotated by `turn` and tilted by `tilt` rad

const reach = Math.max(20, ...keyframes.map(p => Math.hypot(p[0], p[1])));
const home = () => ({ target: [0, 0, 0], distance: 2.4 * reach, turn: -Math.PI / 2, tilt: 1.0 });
let eye = home();

function matrix() {
  const { target, distance, turn, tilt } = eye, f = 1 / Math.tan(0.45), near = distance / 100, far = distance * 20 + 10 * reach;
  const back = [Math.cos(tilt) * Math.cos(turn), Math.cos(tilt) * Math.sin(turn), Math.sin(tilt)];
  const right = [-Math.sin(turn), Math.cos(turn), 0];
  const up = [-Math.sin(tilt) * Math.cos(turn), -Math.sin(tilt) * Math.sin(turn), Math.cos(tilt)];
  const at = target.map((t, i) => t + distance * back[i]), dot = a => -(a[0] * at[0] + a[1] * at[1] + a[2] * at[2]);
  const x = f * canvas.height / canvas.width, a = (far + near) / (near - far), b = 2 * far * near / (near - far);
  return { right, up, m: new Float32Array([
    x * right[0], f * up[0], a * back[0], -back[0], x * right[1], f * up[1], a * back[1], -back[1],
    x * right[2], f * up[2], a * back[2], -back[2], x * dot(right), f * dot(up), a * dot(back) + b, -dot(back)]) };
}

/** Screen position of a map position, CSS pixels from the upper left; null behind the eye. */
function project(p, m = matrix().m) {
  const w = m[3] * p[0] + m[7] * p[1] + m[11] * p[2] + m[15];
  if (w <= 0) return null;
  const x = (m[0] * p[0] + m[4] * p[1] + m[8] * p[2] + m[12]) / w, y = (m[1] * p[0] + m[5] * p[1] + m[9] * p[2] + m[13]) / w;
  return [(x + 1) / 2 * canvas.clientWidth, (1 - y) / 2 * canvas.clientHeight, w];
}

// ---- drawing: while the view moves, as many points as fit into a thirtieth of a second; then the others on top

const on = id => document.getElementById(id).checked;
let budget = 40000, drawn = 0, moved = true, last = 0, frames = 0, rate = 0, since = performance.now();

function frame(now) {
  requestAnimationFrame(frame);
  const moving = moved;
  if (!moved && drawn >= COUNT) { last = 0; return; }
  const spent = last ? now - last : 0;
  last = now;
  if (spent > 30) budget = Math.max(10000, budget * 0.75);
  else if (spent && spent < 22) budget = Math.min(COUNT, budget * 1.25);
  const { m } = matrix(), size = Math.max(1, Math.min(3, 500 / eye.distance)) * devicePixelRatio;
  if (moved) { gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT); drawn = 0; moved = false; }
  const until = on("points") ? Math.min(COUNT, Math.ceil(drawn + budget)) : COUNT;
  gl.useProgram(dots.made);
  gl.uniformMatrix4fv(where.m, false, m);
  gl.uniform1f(where.scale, data.scale); gl.uniform1f(where.size, size); gl.uniform2fv(where.heights, data.heights);
  gl.bindBuffer(gl.ARRAY_BUFFER, cloud.made);
  gl.vertexAttribPointer(0, 3, gl.SHORT, false, 0, 0);
  if (on("points")) gl.drawArrays(gl.POINTS, drawn, until - drawn);
  drawn = until;
  gl.useProgram(plain.made);
  gl.uniformMatrix4fv(line.m, false, m);
  gl.uniform1f(line.size, 6 * devicePixelRatio);
  gl.disable(gl.DEPTH_TEST);
  for (const [name, part] of [...Object.entries(shown), ["", marks]]) {
    if (!part.count || (name && !on(name))) continue;
    gl.uniform4fv(line.color, part.color);
    gl.bindBuffer(gl.ARRAY_BUFFER, part.made);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.drawArrays(part.mode, 0, part.count);
  }
  gl.enable(gl.DEPTH_TEST);
  place();
  if (moving) { frames++; if (now - since > 500) { rate = 1000 * frames / (now - since); frames = 0; since = now; } } else { frames = 0; since = now; }
}

function resize() {
  canvas.width = canvas.clientWidth * devicePixelRatio; canvas.height = canvas.clientHeight * devicePixelRatio;
  gl.viewport(0, 0, canvas.width, canvas.height); moved = true;
}

// ---- what is clicked

function nearest(x, y, within) {
  const { m } = matrix();
  let best = null, distance = within;
  if (on("keyframes")) keyframes.forEach((p, i) => {
    const s = project(p, m), d = s ? Math.hypot(s[0] - x, s[1] - y) : Infinity;
    if (d < distance) { distance = d; best = { keyframe: i }; }
  });
  if (best) return best;
  data.loops.forEach((l, i) => {
    if (!on(l.ok ? "accepted" : "rejected")) return;
    const a = project(keyframes[l.from], m), b = project(keyframes[l.to], m);
    if (!a || !b) return;
    const u = [b[0] - a[0], b[1] - a[1]], t = Math.max(0, Math.min(1, ((x - a[0]) * u[0] + (y - a[1]) * u[1]) / (u[0] ** 2 + u[1] ** 2 || 1)));
    const d = Math.hypot(a[0] + t * u[0] - x, a[1] + t * u[1] - y);
    if (d < distance) { distance = d; best = { loop: i }; }
  });
  return best;
}

/** The cloud point that is seen at a screen position: of the points near it, the one nearest to the eye. */
function surface(x, y) {
  const { m } = matrix(), s = data.scale;
  let best = null, score = Infinity;
  for (let i = 0; i < drawn; i++) {
    const p = [points[3 * i] * s, points[3 * i + 1] * s, points[3 * i + 2] * s], at = project(p, m);
    if (!at) continue;
    const d = Math.hypot(at[0] - x, at[1] - y);
    if (d < 8 && at[2] + d * eye.distance / 200 < score) { score = at[2] + d * eye.distance / 200; best = p; }
  }
  return best;
}

function row(table, name, value, kind) {
  const tr = table.insertRow();
  tr.insertCell().textContent = name;
  const cell = tr.insertCell();
  cell.textContent = value;
  if (kind) cell.className = kind;
}

function about(loop, table) {
  row(table, `${loop.from} - ${loop.to}`, loop.ok ? "accepted" : `rejected: ${loop.reason}`, loop.ok ? "ok" : "no");
  row(table, "", [loop.method, loop.confidence === null ? "" : `confidence ${loop.confidence}`, loop.rmse === null ? "" : `rmse ${loop.rmse} m`].filter(Boolean).join(", "));
}

function show(found) {
  panel.replaceChildren();
  panel.hidden = !found;
  if (!found) return;
  const title = panel.appendChild(document.createElement("h3")), table = document.createElement("table");
  if ("loop" in found) {
    title.textContent = "Loop";
    about(data.loops[found.loop], table);
  } else {
    const k = data.keyframes[found.keyframe];
    title.textContent = `Keyframe ${found.keyframe}`;
    if (k.image) { const image = panel.appendChild(document.createElement("img")); image.alt = title.textContent; image.src = k.image; }
    row(table, "position", k.at.map((v, i) => (v + data.middle[i]).toFixed(2)).join(", ") + " m");
    row(table, "heading", `${k.yaw}°`); row(table, "stamp", `${k.stamp} ns`); row(table, "frame", k.frame);
    row(table, "session", k.robot ? `${k.session}, ${k.robot}` : k.session);
    for (const loop of data.loops) if (loop.from === found.keyframe || loop.to === found.keyframe) about(loop, table);
  }
  panel.appendChild(table);
}

const measure = document.getElementById("measure");
let ends = null;

function mark(end) {
  if (!end) return;
  ends = ends.length < 2 ? [...ends, end] : [end];
  gl.bindBuffer(gl.ARRAY_BUFFER, marks.made);
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(ends.flat()), gl.STATIC_DRAW);
  marks.count = ends.length; marks.mode = ends.length === 2 ? gl.LINES : gl.POINTS;
  moved = true;
}

function place() {
  const both = ends && ends.length === 2, at = both && project(ends[0].map((v, i) => (v + ends[1][i]) / 2));
  label.hidden = !at;
  if (!at) return;
  const d = ends[1].map((v, i) => v - ends[0][i]);
  label.textContent = `${Math.hypot(...d).toFixed(2)} m (level ${Math.hypot(d[0], d[1]).toFixed(2)}, up ${d[2].toFixed(2)})`;
  label.style.left = `${at[0] + 8}px`; label.style.top = `${at[1] + 8}px`;
}

measure.onclick = () => {
  ends = ends ? null : [];
  marks.count = 0; moved = true;
  measure.setAttribute("aria-pressed", String(Boolean(ends)));
};
document.getElementById("home").onclick = () => { eye = home(); moved = true; };
for (const box of document.querySelectorAll("#bar input")) box.onchange = () => { moved = true; };

// ---- the mouse

let held = null;
canvas.onpointerdown = e => { canvas.setPointerCapture(e.pointerId); held = { x: e.clientX, y: e.clientY, way: 0, pan: e.shiftKey || e.button === 2 }; };
canvas.onpointermove = e => {
  if (!held) return;
  const dx = e.clientX - held.x, dy = e.clientY - held.y;
  held.x = e.clientX; held.y = e.clientY; held.way += Math.abs(dx) + Math.abs(dy);
  if (held.way < 4) return;
  if (held.pan) {
    const { right, up } = matrix(), s = eye.distance * 0.97 / canvas.clientHeight;
    eye.target = eye.target.map((t, i) => t - s * dx * right[i] + s * dy * up[i]);
  } else {
    eye.turn -= dx * 0.006; eye.tilt = Math.max(-0.2, Math.min(1.55, eye.tilt + dy * 0.006));
  }
  moved = true;
};
canvas.onpointerup = e => {
  const click = held && held.way < 4;
  held = null;
  if (!click) return;
  const box = canvas.getBoundingClientRect(), x = e.clientX - box.left, y = e.clientY - box.top;
  if (ends) mark(surface(x, y)); else show(nearest(x, y, 12));
};
canvas.oncontextmenu = e => e.preventDefault();
canvas.addEventListener("wheel", e => { e.preventDefault(); eye.distance = Math.max(2, Math.min(40 * reach, eye.distance * Math.exp(e.deltaY * 0.001))); moved = true; }, { passive: false });

gl.enable(gl.DEPTH_TEST);
gl.enableVertexAttribArray(0);
gl.clearColor(0.063, 0.082, 0.102, 1);
document.getElementById("status").textContent =
  `${keyframes.length} keyframes, ${data.loops.filter(l => l.ok).length} loops accepted of ${data.loops.length} tried, ${COUNT.toLocaleString("en")} points`;
new ResizeObserver(resize).observe(canvas);
resize();
requestAnimationFrame(frame);
// For scripts that check the page: screen position of a keyframe or a map position, points drawn so far, frames per second while it moves.
window.dpm2 = { project: i => project(keyframes[i]), at: p => project(p.map((v, i) => v - data.middle[i])), points: COUNT, get drawn() { return drawn; }, get rate() { return rate; } };

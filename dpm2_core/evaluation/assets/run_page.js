"use strict";
// Draws the data that run_page.py put into the page: a map, charts and states for each group of runs of one drive.
const COLORS = ["#d9480f", "#1971c2", "#2f9e44", "#9c36b5", "#e8590c", "#0c8599", "#c2255c", "#5c940d", "#6741d9", "#846358"];
const STATES = { tracking: "#2f9e44", degraded: "#f08c00", lost: "#e03131", initialising: "#868e96" };
const SVG = "http://www.w3.org/2000/svg";

function make(kind, attributes = {}, text = "") {
  const node = document.createElementNS(SVG, kind);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  if (text) node.textContent = text;
  return node;
}
function html(kind, text = "", parent = null, className = "") {
  const node = document.createElement(kind);
  node.textContent = text;
  if (className) node.className = className;
  if (parent) parent.append(node);
  return node;
}
// y up: the picture's y axis points down
const path = (xy) => { let d = ""; for (let i = 0; i < xy.length; i += 2) d += (i ? "L" : "M") + xy[i] + " " + -xy[i + 1]; return d; };

function bounds(group) {
  let low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  for (const xy of [group.truth, ...group.runs.map((run) => run.way)])
    for (let i = 0; i < xy.length; i++) {
      const axis = i % 2;
      low[axis] = Math.min(low[axis], xy[i]); high[axis] = Math.max(high[axis], xy[i]);
    }
  if (!isFinite(low[0])) { low = [-1, -1]; high = [1, 1]; }
  const margin = 0.05 * Math.max(high[0] - low[0], high[1] - low[1], 1);
  return { x: low[0] - margin, y: -high[1] - margin, w: high[0] - low[0] + 2 * margin, h: high[1] - low[1] + 2 * margin };
}

function map(group, parent) {
  const svg = make("svg", { class: "map", role: "img", "aria-label": "Trajectories from above" });
  const whole = bounds(group), layers = {};
  let view = { ...whole };
  const show = () => {
    svg.setAttribute("viewBox", [view.x, view.y, view.w, view.h].join(" "));
    const perPixel = Math.max(view.w / (svg.clientWidth || 800), view.h / (svg.clientHeight || 500));
    for (const circle of svg.querySelectorAll("circle")) circle.setAttribute("r", 4 * perPixel);
    scale.textContent = "width " + Math.round(perPixel * (svg.clientWidth || 800)) + " m; drag to move, turn the wheel to zoom";
  };
  const layer = (name) => (layers[name] = svg.appendChild(make("g", { fill: "none", "stroke-width": 2 })));
  const line = (into, d, color, more = {}) => into.append(make("path", { d, stroke: color, "vector-effect": "non-scaling-stroke", ...more }));
  if (group.truth.length) line(layer("ground truth"), path(group.truth), "#868e96", { "stroke-dasharray": "6 4" });
  const rejected = layer("loops rejected"), accepted = layer("loops accepted");
  group.runs.forEach((run, i) => {
    const into = layer(run.name);
    line(into, path(run.way), COLORS[i % COLORS.length]);
    if (run.way.length) into.append(make("circle", { cx: run.way[0], cy: -run.way[1], fill: COLORS[i % COLORS.length] }));
    for (const [x, y, u, v, ok, reason] of run.loops) {
      const loop = make("path", { d: path([x, y, u, v]), stroke: ok ? "#2f9e44" : "#e03131", "vector-effect": "non-scaling-stroke",
        "stroke-width": ok ? 2 : 1, class: ok ? "accepted" : "rejected" });
      loop.append(make("title", {}, run.name + ": " + (ok ? "loop accepted" : "loop rejected: " + reason)));
      (ok ? accepted : rejected).append(loop);
    }
  });
  rejected.style.display = "none";
  const legend = html("div", "", parent, "legend");
  Object.keys(layers).forEach((name) => {
    if (/^loops/.test(name) && !layers[name].childElementCount) return;
    const label = html("label", "", legend), box = html("input", "", label), swatch = html("i", "", label);
    const first = layers[name].querySelector("path");
    swatch.style.background = first ? first.getAttribute("stroke") : "none";
    box.type = "checkbox"; box.checked = layers[name].style.display !== "none";
    box.addEventListener("change", () => { layers[name].style.display = box.checked ? "" : "none"; });
    label.append(name);
  });
  const reset = html("button", "Whole", legend);
  reset.addEventListener("click", () => { view = { ...whole }; show(); });
  parent.append(svg);
  const scale = html("p", "", parent);
  const point = (event) => {
    const matrix = svg.getScreenCTM().inverse(), p = new DOMPoint(event.clientX, event.clientY).matrixTransform(matrix);
    return [p.x, p.y];
  };
  svg.addEventListener("wheel", (event) => {
    event.preventDefault();
    const [x, y] = point(event), factor = Math.exp(0.0015 * event.deltaY);
    view = { x: x - (x - view.x) * factor, y: y - (y - view.y) * factor, w: view.w * factor, h: view.h * factor };
    show();
  }, { passive: false });
  let held = null;
  svg.addEventListener("pointerdown", (event) => { held = point(event); svg.setPointerCapture(event.pointerId); });
  svg.addEventListener("pointermove", (event) => {
    if (!held) return;
    const [x, y] = point(event);
    view.x += held[0] - x; view.y += held[1] - y;
    show();
  });
  for (const name of ["pointerup", "pointercancel"]) svg.addEventListener(name, () => { held = null; });
  show();
}

// Lines through points [x, y] of several runs, with axes.
function chart(parent, title, unit, series) {
  const drawn = series.filter(([, points]) => points.length);
  if (!drawn.length) return;
  const box = html("div", "", parent), W = 380, H = 210, left = 48, bottom = 28, top = 10;
  html("h3", title, box);
  const svg = make("svg", { viewBox: `0 0 ${W} ${H}`, class: "chart", role: "img", "aria-label": title });
  const all = drawn.flatMap(([, points]) => points), xs = all.map((p) => p[0]);
  const x0 = Math.min(...xs), x1 = Math.max(...xs), y1 = Math.max(...all.map((p) => p[1])) || 1;
  const X = (x) => left + (W - left - 12) * (x1 > x0 ? (x - x0) / (x1 - x0) : 0.5), Y = (y) => H - bottom - (H - bottom - top) * (y / y1);
  for (const part of [0, 0.5, 1]) {
    svg.append(make("line", { x1: left, x2: W - 12, y1: Y(part * y1), y2: Y(part * y1), stroke: "#868e9655" }));
    svg.append(make("text", { x: left - 6, y: Y(part * y1) + 4, "text-anchor": "end" }, (part * y1).toPrecision(2)));
    svg.append(make("text", { x: X(x0 + part * (x1 - x0)), y: H - 10, "text-anchor": "middle" }, String(Math.round(x0 + part * (x1 - x0)))));
  }
  svg.append(make("text", { x: W - 12, y: H - 1, "text-anchor": "end" }, unit));
  for (const [i, points] of drawn) {
    const color = COLORS[i % COLORS.length], d = points.map((p, k) => (k ? "L" : "M") + X(p[0]).toFixed(1) + " " + Y(p[1]).toFixed(1)).join("");
    svg.append(make("path", { d, fill: "none", stroke: color, "stroke-width": 2 }));
    if (points.length < 30) for (const p of points) svg.append(make("circle", { cx: X(p[0]), cy: Y(p[1]), r: 3, fill: color }));
  }
  box.append(svg);
}

function stages(group, parent) {
  const names = [...new Set(group.runs.flatMap((run) => Object.keys(run.stages)))].filter((name) => name !== "total");
  const rows = group.runs.filter((run) => names.some((name) => run.stages[name]));
  if (!rows.length) return;
  html("h3", "Mean time of a frame by stage, ms", parent);
  const most = Math.max(...rows.map((run) => names.reduce((sum, name) => sum + (run.stages[name] || 0), 0)));
  const svg = make("svg", { viewBox: `0 0 900 ${22 * rows.length + 8}`, class: "stages" });
  rows.forEach((run, i) => {
    let x = 230;
    svg.append(make("text", { x: 4, y: 22 * i + 17 }, run.name.slice(-36)));
    names.forEach((name, k) => {
      const width = 560 * (run.stages[name] || 0) / most;
      const bar = make("rect", { x, y: 22 * i + 4, width, height: 16, fill: COLORS[k % COLORS.length] });
      bar.append(make("title", {}, name + ": " + (run.stages[name] || 0) + " ms"));
      svg.append(bar); x += width;
    });
    svg.append(make("text", { x: x + 6, y: 22 * i + 17 }, names.reduce((sum, name) => sum + (run.stages[name] || 0), 0).toFixed(1)));
  });
  parent.append(svg);
  const legend = html("div", "", parent, "legend");
  names.forEach((name, k) => { const label = html("span", "", legend); html("i", "", label).style.background = COLORS[k % COLORS.length]; label.append(name); });
}

function states(group, parent) {
  const rows = group.runs.filter((run) => run.states.some(([name]) => name));
  if (!rows.length) return;
  html("h3", "States along the drive", parent);
  const svg = make("svg", { viewBox: `0 0 900 ${22 * rows.length + 8}`, class: "states" });
  rows.forEach((run, i) => {
    const frames = run.states.reduce((sum, [, count]) => sum + count, 0);
    svg.append(make("text", { x: 4, y: 22 * i + 17 }, run.name.slice(-36)));
    let x = 230;
    for (const [name, count] of run.states) {
      const width = 660 * count / frames, bar = make("rect", { x, y: 22 * i + 4, width: Math.max(width, 0.5), height: 16, fill: STATES[name] || "#1971c2" });
      bar.append(make("title", {}, name + ": " + count + " frames"));
      svg.append(bar); x += width;
    }
  });
  parent.append(svg);
  const legend = html("div", "", parent, "legend");
  for (const [name, color] of Object.entries(STATES)) { const label = html("span", "", legend); html("i", "", label).style.background = color; label.append(name); }
}

const root = document.getElementById("groups");
for (const group of JSON.parse(document.getElementById("data").textContent)) {
  const section = html("section", "", root);
  html("h2", group.name, section);
  map(group, section);
  const charts = html("div", "", section, "charts"), of = (pick) => group.runs.map((run, i) => [i, pick(run)]);
  chart(charts, "Translation error by length, %", "m", of((run) => run.byLength.map((row) => [row[0], row[1]])));
  chart(charts, "Rotation error by length, deg/100 m", "m", of((run) => run.byLength.map((row) => [row[0], row[2]])));
  // Errors by speed are means over all lengths: with other lengths they are other figures.
  for (const lengths of new Set(group.runs.map((run) => run.segments))) {
    const bySpeed = (k) => of((run) => (run.segments === lengths ? run.bySpeed : []).map((row) => [row[0], row[k]]));
    chart(charts, `Translation error by speed, %${lengths}`, "m/s", bySpeed(1));
    chart(charts, `Rotation error by speed, deg/100 m${lengths}`, "m/s", bySpeed(2));
  }
  chart(charts, "Time of a frame along the drive, ms", "% of the drive", of((run) => run.time.map((ms, k) => [100 * k / run.time.length, ms])));
  stages(group, section);
  states(group, section);
}

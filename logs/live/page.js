"use strict";
// Draws what comes from /scenes. Paths are collected here, from the moment on at which the page was opened.
const PATH = 300, MINUTE_S = 60, COLOURS = 7;
const byId = (id) => document.getElementById(id);
const paths = new Map(), ages = [];
let scene = null, heard = 0;

const colourOf = (number) => colour("v" + (number % COLOURS));
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();

function canvasOf(id) {
  const canvas = byId(id), ratio = window.devicePixelRatio || 1, width = canvas.clientWidth;
  const height = Number(canvas.dataset.height || (canvas.dataset.height = canvas.getAttribute("height")));
  canvas.style.height = height + "px";
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  pen.font = "12px system-ui, sans-serif";
  return [pen, width, height];
}

// A view from above: across = east, up = north; from the south: across = east, up = height.
function drawView(id, up) {
  const [pen, width, height] = canvasOf(id);
  const flat = (at) => [at[1], up === 2 ? -at[2] : at[0]];
  const seen = [];
  const corners = (box) => {
    if (!box) return null;
    const low = box.lower_m, high = box.upper_m;
    const span = up === 2 ? [high[2] === null ? null : -high[2], low[2] === null ? null : -low[2]] : [low[0], high[0]];
    return {left: low[1], right: high[1], bottom: span[0], top: span[1]};
  };
  const box = corners(scene.box), margins = corners(scene.margins);
  for (const body of scene.bodies) seen.push(flat(body.at_m));
  for (const one of scene.vehicles) {
    for (const at of [one.at_m, one.target_m, ...one.plan]) if (at) seen.push(flat(at));
  }
  const vehicleBoxes = scene.vehicles.map((one) => one.boxes.map(corners));
  for (const path of paths.values()) for (const at of path) seen.push(flat(at));
  if (scene.target_m) seen.push(flat(scene.target_m));
  for (const sides of [box, ...vehicleBoxes.flat()]) {
    if (!sides) continue;
    for (const x of [sides.left, sides.right]) if (x !== null) seen.push([x, seen.length ? seen[0][1] : 0]);
    for (const y of [sides.bottom, sides.top]) if (y !== null) seen.push([seen.length ? seen[0][0] : 0, y]);
  }
  if (!seen.length) return;
  const xs = seen.map((at) => at[0]), ys = seen.map((at) => at[1]);
  const x0 = Math.min(...xs), x1 = Math.max(...xs), y0 = Math.min(...ys), y1 = Math.max(...ys);
  const scale = Math.min((width - 60) / Math.max(x1 - x0, 1), (height - 50) / Math.max(y1 - y0, 1));
  const px = (x) => width / 2 + (x - (x0 + x1) / 2) * scale, py = (y) => height / 2 - (y - (y0 + y1) / 2) * scale;
  const line = (points, ink, wide, dash) => {
    pen.strokeStyle = ink; pen.lineWidth = wide; pen.setLineDash(dash || []);
    pen.beginPath();
    points.forEach((at, i) => (i ? pen.lineTo(px(at[0]), py(at[1])) : pen.moveTo(px(at[0]), py(at[1]))));
    pen.stroke(); pen.setLineDash([]);
  };
  const frame = (sides, ink, dash) => {
    const left = sides.left ?? x0, right = sides.right ?? x1, bottom = sides.bottom ?? y0, top = sides.top ?? y1;
    if (sides.left !== null) line([[left, bottom], [left, top]], ink, 1.5, dash);
    if (sides.right !== null) line([[right, bottom], [right, top]], ink, 1.5, dash);
    if (sides.bottom !== null) line([[left, bottom], [right, bottom]], ink, 1.5, dash);
    if (sides.top !== null) line([[left, top], [right, top]], ink, 1.5, dash);
  };
  if (box) frame(box, colour("muted"));
  if (margins) frame(margins, colour("margin"), [5, 4]);
  const numbers = new Map(scene.vehicles.map((one, number) => [one.name, number]));
  const inkOf = (name) => numbers.has(name) ? colourOf(numbers.get(name)) : colour(name === "truth" ? "plain" : "good");
  for (const [name, path] of paths) line(path.map(flat), inkOf(name), 1.5);
  if (scene.plan.length) line(scene.plan.map(flat), colour("plan"), 2.5);
  const cross = (at, ink) => {
    const [x, y] = flat(at);
    line([[x - 8 / scale, y], [x + 8 / scale, y]], ink, 1.5);
    line([[x, y - 8 / scale], [x, y + 8 / scale]], ink, 1.5);
  };
  const dot = (name, at, ink, below) => {
    const [x, y] = flat(at);
    pen.fillStyle = ink;
    pen.beginPath(); pen.arc(px(x), py(y), 5, 0, 7); pen.fill();
    const room = px(x) + 8 + pen.measureText(name).width < width;
    pen.textAlign = room ? "left" : "right";
    pen.fillText(name, px(x) + (room ? 8 : -8), py(y) + (below ? 14 : -6));
  };
  if (scene.target_m) cross(scene.target_m, colour("ink"));
  for (const body of scene.bodies) dot(body.name, body.at_m, colour(body.level), body.name === "truth");
  scene.vehicles.forEach((one, number) => {
    const ink = colourOf(number);
    for (const sides of vehicleBoxes[number]) frame(sides, ink, [2, 3]);
    if (one.plan.length) line(one.plan.map(flat), ink, 3);
    if (one.target_m) cross(one.target_m, ink);
    if (!one.at_m) return;
    dot(one.name, one.at_m, ink);
    if (one.level === "good" || one.level === "plain") return;
    const [x, y] = flat(one.at_m);
    pen.strokeStyle = colour(one.level); pen.lineWidth = 3;
    pen.beginPath(); pen.arc(px(x), py(y), 10, 0, 7); pen.stroke();
  });
  pen.textAlign = "left";
  pen.fillStyle = colour("muted");
  const rod = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find((metres) => metres * scale > 40) || 100;
  pen.fillRect(10, height - 10, rod * scale, 2);
  pen.fillText(rod + " m", 10, height - 15);
}

function drawAges() {
  byId("ages").hidden = scene.age_s === null && !ages.length;
  if (byId("ages").hidden || !ages.length) return;
  const [pen, width, height] = canvasOf("age");
  const now = ages[ages.length - 1][0], limit = scene.age_limit_s;
  const most = Math.max(0.2, ...ages.map((one) => one[1])) * 1.15;
  const px = (t) => width - 8 - ((now - t) / MINUTE_S) * (width - 48), py = (age) => height - 18 - (age / most) * (height - 34);
  pen.fillStyle = colour("muted");
  pen.fillText("0 s", 4, height - 14);
  pen.fillText(most.toFixed(1) + " s", 4, 14);
  pen.fillText("a minute ago", 40, height - 3);
  pen.textAlign = "right"; pen.fillText("now", width - 8, height - 3); pen.textAlign = "left";
  if (limit !== null && limit < most) {
    pen.strokeStyle = colour("bad"); pen.setLineDash([5, 4]);
    pen.beginPath(); pen.moveTo(40, py(limit)); pen.lineTo(width - 8, py(limit)); pen.stroke(); pen.setLineDash([]);
    pen.fillText("plan's end", 44, py(limit) - 4);
  }
  pen.strokeStyle = colour("plan"); pen.lineWidth = 1.5; pen.beginPath();
  ages.forEach(([t, age], i) => (i ? pen.lineTo(px(t), py(age)) : pen.moveTo(px(t), py(age))));
  pen.stroke();
}

function row(cells, level, kind) {
  const tr = document.createElement("tr");
  cells.forEach((text, i) => {
    const cell = document.createElement(kind || (i ? "td" : "th"));
    cell.textContent = text;
    if (i) cell.className = level;
    tr.append(cell);
  });
  return tr;
}

function drawTable() {
  byId("fleet").hidden = !scene.vehicles.length;
  byId("now").hidden = !!scene.vehicles.length;
  byId("messages").className = scene.vehicles.length ? "wide" : "";
  byId("columns").replaceChildren(row(scene.columns, "", "th"));
  byId("vehicles").replaceChildren(...scene.vehicles.map((one, number) => {
    const tr = row(one.cells, one.level);
    tr.firstChild.style.color = colourOf(number);
    return tr;
  }));
}

function draw() {
  byId("title").textContent = scene.title + ", " + scene.time_s.toFixed(1) + " s";
  const head = byId("headline");
  head.textContent = scene.headline;
  head.className = scene.level;
  drawView("above", 0);
  drawView("side", 2);
  drawAges();
  drawTable();
  byId("figures").replaceChildren(...scene.figures.map((one) => row([one.name, one.value], one.level)));
  byId("events").replaceChildren(...scene.events.map((one) => {
    const item = document.createElement("li");
    item.className = one.level;
    item.textContent = one.time_s.toFixed(1) + " s  " + one.text;
    return item;
  }));
}

const source = new EventSource("/scenes");
source.onmessage = (message) => {
  const next = JSON.parse(message.data);
  heard = Date.now();
  if (!next) return;
  if (scene && next.time_s < scene.time_s) { paths.clear(); ages.length = 0; }
  scene = next;
  for (const body of [...scene.bodies, ...scene.vehicles.filter((one) => one.at_m)]) {
    const path = paths.get(body.name) || [];
    path.push(body.at_m);
    if (path.length > PATH) path.shift();
    paths.set(body.name, path);
  }
  if (scene.age_s !== null) ages.push([scene.time_s, scene.age_s]);
  while (ages.length && ages[0][0] < scene.time_s - MINUTE_S) ages.shift();
  draw();
};
// An old state looks like a vehicle at rest, so the page marks it as old.
setInterval(() => {
  if (heard && Date.now() - heard > 1000) {
    const head = byId("headline");
    head.textContent = "no data for " + Math.round((Date.now() - heard) / 1000) + " s: the program has ended or hangs";
    head.className = "bad";
  }
}, 500);
window.addEventListener("resize", () => scene && draw());

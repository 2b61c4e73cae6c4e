"use strict";
// Draws the scenes of /scenes and the history of /history, and gives orders by /orders.
const CAPACITY = 2000, COLOURS = 7, ANSWER_MS = 15000, NEAR_PX = 16, SILENCE_MS = 1000;
const PLACE = ["north", "east", "height"]; // fields of the place to go to
const byId = (id) => document.getElementById(id);
const token = location.hash.slice(1);
let scene = null, heard = 0, samples = [], period = 0.1;
let takers = [], chosen = "", view = null;
// The token is in memory alone: neither the history of the browser nor a copied address has it.
if (token) history.replaceState(null, "", location.pathname);

const colourOf = (number) => colour("v" + (number % COLOURS));
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();

// A sample is [bin, time, largest age in the bin, newest positions by name], as in logs/live/history.py.
function merge(sample, next) {
  const age = sample[2] === null || next[2] === null ? sample[2] ?? next[2] : Math.max(sample[2], next[2]);
  return [next[0], next[1], age, {...sample[3], ...next[3]}];
}

function push(list, next) {
  const last = list[list.length - 1];
  if (last && last[0] === next[0]) list[list.length - 1] = merge(last, next);
  else list.push(next);
}

function addSample(time, age, places) {
  if (samples.length && time < samples[samples.length - 1][1]) samples = [];
  push(samples, [Math.floor(time / period), time, age, places]);
  while (samples.length > CAPACITY) {
    period *= 2;
    const coarse = [];
    for (const one of samples) push(coarse, [Math.floor(one[1] / period), one[1], one[2], one[3]]);
    samples = coarse;
  }
}

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

function markedPlace() {
  const values = PLACE.map((id) => byId(id).valueAsNumber);
  return values.every(Number.isFinite) ? [values[0], values[1], -values[2]] : null;
}

// A view from above: across = east, up = north; from the south: across = east, up = height.
function drawView(id, up) {
  const [pen, width, height] = canvasOf(id);
  const flat = (at) => [at[1], up === 2 ? -at[2] : at[0]];
  let x0 = Infinity, x1 = -Infinity, y0 = Infinity, y1 = -Infinity;
  const spanX = (x) => { x0 = Math.min(x0, x); x1 = Math.max(x1, x); };
  const spanY = (y) => { y0 = Math.min(y0, y); y1 = Math.max(y1, y); };
  const include = (at) => { const [x, y] = flat(at); spanX(x); spanY(y); };
  const corners = (box) => {
    if (!box) return null;
    const low = box.lower_m, high = box.upper_m;
    const span = up === 2 ? [high[2] === null ? null : -high[2], low[2] === null ? null : -low[2]] : [low[0], high[0]];
    return {left: low[1], right: high[1], bottom: span[0], top: span[1]};
  };
  const box = corners(scene.box), margins = corners(scene.margins), goal = takers.length ? markedPlace() : null;
  const paths = new Map();
  for (const sample of samples) {
    for (const name in sample[3]) {
      if (!paths.has(name)) paths.set(name, []);
      paths.get(name).push(flat(sample[3][name]));
      include(sample[3][name]);
    }
  }
  for (const body of scene.bodies) include(body.at_m);
  for (const one of scene.vehicles) {
    for (const at of [one.at_m, one.target_m, ...one.plan]) if (at) include(at);
  }
  const vehicleBoxes = scene.vehicles.map((one) => one.boxes.map(corners));
  if (scene.target_m) include(scene.target_m);
  for (const sides of [box, ...vehicleBoxes.flat()]) {
    if (!sides) continue;
    for (const x of [sides.left, sides.right]) if (x !== null) spanX(x);
    for (const y of [sides.bottom, sides.top]) if (y !== null) spanY(y);
  }
  if (x0 > x1 && y0 > y1) return;
  if (x0 > x1) x0 = x1 = 0;
  if (y0 > y1) y0 = y1 = 0;
  const scale = Math.min((width - 60) / Math.max(x1 - x0, 1), (height - 50) / Math.max(y1 - y0, 1));
  const px = (x) => width / 2 + (x - (x0 + x1) / 2) * scale, py = (y) => height / 2 - (y - (y0 + y1) / 2) * scale;
  if (up === 0) {
    const metresOf = (x, y) => [(y0 + y1) / 2 + (height / 2 - y) / scale, (x0 + x1) / 2 + (x - width / 2) / scale];
    view = {pixelsOf: (at) => [px(at[1]), py(at[0])], metresOf};
  }
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
  for (const [name, path] of paths) line(path, inkOf(name), 1.5);
  if (scene.plan.length) line(scene.plan.map(flat), colour("plan"), 2.5);
  const cross = (at, ink) => {
    const [x, y] = flat(at);
    line([[x - 8 / scale, y], [x + 8 / scale, y]], ink, 1.5);
    line([[x, y - 8 / scale], [x, y + 8 / scale]], ink, 1.5);
  };
  const ring = (at, ink, radius) => {
    const [x, y] = flat(at);
    pen.strokeStyle = ink; pen.lineWidth = radius > 8 ? 3 : 1.5;
    pen.beginPath(); pen.arc(px(x), py(y), radius, 0, 7); pen.stroke();
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
  if (goal) { cross(goal, colour("bad")); ring(goal, colour("bad"), 7); }
  for (const body of scene.bodies) dot(body.name, body.at_m, colour(body.level), body.name === "truth");
  scene.vehicles.forEach((one, number) => {
    const ink = colourOf(number);
    for (const sides of vehicleBoxes[number]) frame(sides, ink, [2, 3]);
    if (one.plan.length) line(one.plan.map(flat), ink, 3);
    if (one.target_m) cross(one.target_m, ink);
    if (!one.at_m) return;
    dot(one.name, one.at_m, ink);
    if (one.name === chosen && takers.length > 1) ring(one.at_m, colour("ink"), 8);
    if (one.level === "bad" || one.level === "warn") ring(one.at_m, colour(one.level), 11);
  });
  pen.textAlign = "left";
  pen.fillStyle = colour("muted");
  const rod = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50].find((metres) => metres * scale > 40) || 100;
  pen.fillRect(10, height - 10, rod * scale, 2);
  pen.fillText(rod + " m", 10, height - 15);
}

function drawAges() {
  const ages = samples.filter((one) => one[2] !== null);
  byId("ages").hidden = !ages.length;
  if (!ages.length) return;
  const [pen, width, height] = canvasOf("age");
  const begin = samples[0][1], now = samples[samples.length - 1][1], limit = scene.age_limit_s;
  const most = ages.reduce((largest, one) => Math.max(largest, one[2]), 0.2) * 1.15, span = Math.max(now - begin, 1);
  const px = (t) => 40 + ((t - begin) / span) * (width - 48), py = (age) => height - 18 - (age / most) * (height - 34);
  pen.fillStyle = colour("muted");
  pen.fillText("0 s", 4, height - 14);
  pen.fillText(most.toFixed(1) + " s", 4, 14);
  pen.fillText(begin.toFixed(0) + " s", 40, height - 3);
  pen.textAlign = "right"; pen.fillText("now", width - 8, height - 3); pen.textAlign = "left";
  if (limit !== null && limit < most) {
    pen.strokeStyle = colour("bad"); pen.setLineDash([5, 4]);
    pen.beginPath(); pen.moveTo(40, py(limit)); pen.lineTo(width - 8, py(limit)); pen.stroke(); pen.setLineDash([]);
    pen.fillText("plan's end", 44, py(limit) - 4);
  }
  pen.strokeStyle = colour("plan"); pen.lineWidth = 1.5; pen.beginPath();
  ages.forEach((one, i) => (i ? pen.lineTo(px(one[1]), py(one[2])) : pen.moveTo(px(one[1]), py(one[2]))));
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
    tr.className = one.name === chosen && takers.length > 1 ? "chosen" : "";
    return tr;
  }));
}

function listItem(text, level) {
  const item = document.createElement("li");
  item.className = level;
  item.textContent = text;
  return item;
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
  byId("events").replaceChildren(...scene.events.map((one) => listItem(one.time_s.toFixed(1) + " s  " + one.text, one.level)));
}

async function loadHistory() {
  try {
    const answer = await fetch("/history");
    if (answer.ok) ({period_s: period, samples} = await answer.json());
  } catch { /* the next connection asks again */ }
}

const source = new EventSource("/scenes");
source.onopen = loadHistory;
source.onmessage = (message) => {
  const next = JSON.parse(message.data);
  heard = Date.now();
  if (!next) return;
  scene = next;
  const places = {};
  for (const body of [...scene.bodies, ...scene.vehicles]) if (body.at_m) places[body.name] = body.at_m;
  addSample(scene.time_s, scene.age_s, places);
  draw();
};
// An old state looks like a vehicle at rest, so the page marks it as old.
setInterval(() => {
  if (heard && Date.now() - heard > SILENCE_MS) {
    const head = byId("headline");
    head.textContent = "no data for " + Math.round((Date.now() - heard) / 1000) + " s: the program has ended or hangs";
    head.className = "bad";
  }
}, 500);
window.addEventListener("resize", () => scene && draw());

// Orders

async function loadOrders() {
  let offer = null;
  try {
    const answer = await fetch("/orders", {headers: {"X-Uavctl-Token": token}});
    if (answer.ok) offer = await answer.json();
  } catch { /* a busy computer: it is asked again */ }
  if (!offer) return setTimeout(loadOrders, 1000);
  byId("note").hidden = !offer.vehicles.length || offer.permitted;
  if (!offer.permitted) return;
  takers = offer.vehicles;
  byId("vehicle").replaceChildren(...takers.map((name) => new Option(name, name)));
  byId("choice").hidden = byId("all").hidden = takers.length < 2;
  byId("controls").hidden = false;
  choose(takers[0]);
}

function choose(name) {
  if (name !== chosen) for (const id of PLACE) byId(id).value = "";
  chosen = byId("vehicle").value = name;
  updateGoto();
}

function showAnswers(answers) {
  byId("answers").replaceChildren(...answers.map(([text, level]) => listItem(text, level)));
}

async function giveOrder(order, vehicles) {
  const request = {order, vehicles};
  if (order === "goto") request.position_m = markedPlace();
  showAnswers([[order + " sent to " + vehicles.join(", "), "plain"]]);
  try {
    const headers = {"Content-Type": "application/json", "X-Uavctl-Token": token};
    const signal = AbortSignal.timeout(ANSWER_MS);
    const answer = await fetch("/orders", {method: "POST", headers, body: JSON.stringify(request), signal});
    if (!answer.ok) return showAnswers([[order + " refused: " + await answer.text(), "bad"]]);
    showAnswers((await answer.json()).map((one) =>
      [one.vehicle + ": " + order + (one.ok ? " accepted: " : " refused: ") + one.text, one.ok ? "good" : "bad"]));
  } catch (error) {
    showAnswers([[order + ": no answer (" + error.message + "); watch the vehicle, and use uavctl ctl", "bad"]]);
  }
}

function placeOf(name) {
  const body = takers.length > 1 ? scene.vehicles.find((one) => one.name === name)
    : scene.bodies.find((one) => one.name === "estimate") || scene.vehicles[0];
  return body && body.at_m;
}

// A click near a vehicle of a fleet chooses it; elsewhere it is the place to go to, at the vehicle's height at first.
function clickMap(event) {
  if (!takers.length || !scene || !view) return;
  const distance = (one) => {
    const [x, y] = view.pixelsOf(one.at_m);
    return Math.hypot(x - event.offsetX, y - event.offsetY);
  };
  const near = scene.vehicles.filter((one) => one.at_m && takers.includes(one.name) && distance(one) < NEAR_PX);
  if (near.length && takers.length > 1) {
    choose(near.reduce((best, one) => (distance(one) < distance(best) ? one : best)).name);
    return;
  }
  const [north, east] = view.metresOf(event.offsetX, event.offsetY), at = placeOf(chosen);
  byId("north").value = north.toFixed(2);
  byId("east").value = east.toFixed(2);
  if (!byId("height").value && at) byId("height").value = (-at[2]).toFixed(1);
  updateGoto();
}

function updateGoto() {
  document.querySelector("[data-order=goto]").disabled = !markedPlace();
  if (scene) draw();
}

for (const button of document.querySelectorAll("[data-order]")) {
  button.onclick = () => giveOrder(button.dataset.order, "all" in button.dataset ? takers : [chosen]);
}
for (const id of PLACE) byId(id).oninput = updateGoto;
byId("vehicle").onchange = () => choose(byId("vehicle").value);
byId("above").onclick = clickMap;
loadOrders();

// One moment of the flight in all drawings: a line in those over time, a dot in those of the path.
(() => {
  const flight = DATA;
  const add = (parent, tag, given, text) => {
    const one = document.createElementNS(parent.namespaceURI, tag);
    for (const name in given) one.setAttribute(name, given[name]);
    if (text) one.textContent = text;
    return parent.appendChild(one);
  };
  // The place at a time, by a line between the two rows [time, north, east, down] around it.
  const place = (rows, t) => {
    if (!rows.length || t < rows[0][0] || t > rows[rows.length - 1][0]) return null;
    let i = 1;
    while (i < rows.length - 1 && rows[i][0] < t) i++;
    const a = rows[i - 1], b = rows[i] || a, part = b[0] > a[0] ? (t - a[0]) / (b[0] - a[0]) : 0;
    return [1, 2, 3].map(k => a[k] + part * (b[k] - a[k]));
  };
  const said = t => flight.modes.reduce((found, [at, mode]) => (at <= t ? mode : found), "");
  const onto = (p, [x, y]) => [x, y].map(row => row[0] * p[0] + row[1] * p[1] + row[2] * p[2]);
  const movers = [], clicks = [];

  for (const svg of document.querySelectorAll("svg[data-time]")) {
    const [x0, x1, from, to, low, high] = svg.dataset.time.split(" ").map(Number);
    const line = add(svg, "path", {class: "moment", d: `M0 ${low}V${high}`});
    const view = () => svg.view || [from, to]; // zoomed, it shows a part
    movers.push(t => {
      const [a, b] = view();
      line.style.display = t < a || t > b ? "none" : "";
      line.setAttribute("transform", `translate(${x0 + (t - a) / (b - a) * (x1 - x0)} 0)`);
    });
    clicks.push([svg, x => view()[0] + (x - x0) / (x1 - x0) * (view()[1] - view()[0])]);
  }
  for (const view in flight.views) {
    for (const svg of document.querySelectorAll(`svg[data-${view}]`)) {
      const [x0, x1, left, right, y0, y1, low, high] = svg.dataset[view].split(" ").map(Number);
      for (const [kind, rows] of [["estimated", flight.estimated], ["true", flight.course]]) {
        const dot = add(svg, "circle", {class: "moment " + kind, r: kind === "true" ? 4.2 : 5.6});
        movers.push(t => {
          const p = place(rows, t);
          dot.style.display = p ? "" : "none";
          if (!p) return;
          const [x, y] = onto(p, flight.views[view]);
          dot.setAttribute("cx", x0 + (x - left) / (right - left) * (x1 - x0));
          dot.setAttribute("cy", y0 + (y - low) / (high - low) * (y1 - y0));
        });
      }
      for (const fence of flight.fences.filter(one => one.view === view)) {
        const line = add(svg, "path", {class: "moment", d: fence.along ? `M${x0} 0H${x1}` : `M0 ${y0}V${y1}`});
        movers.push(t => {
          const p = place(fence.rows, t);
          line.style.display = p ? "" : "none";
          if (!p) return;
          line.setAttribute("transform", fence.along
            ? `translate(0 ${y0 + (p[0] - low) / (high - low) * (y1 - y0)})`
            : `translate(${x0 + (p[0] - left) / (right - left) * (x1 - x0)} 0)`);
        });
      }
    }
  }

  const bar = add(document.body, "form", {class: "cursor"});
  const input = add(add(bar, "label", {}, "Time "), "input", {
    type: "range", min: 0, max: flight.end_s, step: flight.step_s, "aria-label": "Moment shown in all drawings",
  });
  const output = add(bar, "output", {});
  const show = () => {
    const t = Number(input.value), p = place(flight.course, t), q = place(flight.estimated, t);
    for (const move of movers) move(t);
    const off = p && q ? Math.hypot(p[0] - q[0], p[1] - q[1], p[2] - q[2]) : 0;
    const parts = [`${t.toFixed(1)} s`, said(t)];
    if (p || q) {
      const [north, east] = (p || q).map(value => value.toFixed(2).replace("-", "−"));
      parts.push(`north ${north}, east ${east}, height ${(-(p || q)[2]).toFixed(2).replace("-", "−")} m`);
    }
    if (p && q) parts.push(`estimate ${off.toFixed(2)} m off`);
    output.textContent = parts.filter(Boolean).join(" · ");
  };
  for (const [svg, time] of clicks) {
    svg.addEventListener("click", event => {
      const box = svg.getBoundingClientRect();
      input.value = time((event.clientX - box.left) / box.width * svg.viewBox.baseVal.width);
      show();
    });
  }
  bar.addEventListener("submit", event => event.preventDefault());
  input.addEventListener("input", show);
  document.addEventListener("view", show);
  input.value = flight.at_s;
  show();
})();

// Zoom and pan. Drawings over time share one span of time; all others move within their frame. The wheel with Ctrl (as a
// pinch on a touch pad sends it), the wheel after a click, or two fingers zoom. Dragging pans, a double click shows all
// again. Only x is stretched over time, so strokes keep their width.
(() => {
  const LEAST = 1 / 500; // of a drawing's own span
  const timed = [];
  let span = null; // [from, to] shown by all drawings over time; null: each shows its own

  const nice = length => {
    const unit = 10 ** Math.floor(Math.log10(length / 5));
    return unit * [1, 2, 5, 10].find(k => k * unit >= length / 5);
  };

  const overTime = svg => {
    const [x0, x1, from, to, low, high] = svg.dataset.time.split(" ").map(Number);
    const axis = svg.querySelector('[id$="matplotlib.axis_1"]'), axes = axis.parentNode;
    const ticks = [...axis.children].filter(one => /xtick_\d+$/.test(one.id));
    const stretched = [], texts = [];
    for (const one of [...axes.querySelectorAll("[clip-path]")]) {
      if (one.closest('[id*="matplotlib.axis"]')) continue;
      // What clips must not be stretched with what it clips.
      const frame = document.createElementNS(svg.namespaceURI, "g"), inner = document.createElementNS(svg.namespaceURI, "g");
      frame.setAttribute("clip-path", one.getAttribute("clip-path"));
      one.removeAttribute("clip-path");
      one.replaceWith(frame);
      frame.append(inner);
      inner.append(one);
      const marks = one.querySelectorAll("use"); // markers of a line keep their shape; areas do not
      if (marks.length && one.closest('[id*="-line2d_"]')) marks.forEach(mark => texts.push([mark, Number(mark.getAttribute("x"))]));
      else stretched.push(inner);
      one.querySelectorAll("path").forEach(path => path.setAttribute("vector-effect", "non-scaling-stroke"));
      if (one.tagName === "path") one.setAttribute("vector-effect", "non-scaling-stroke");
    }
    for (const text of axes.querySelectorAll(':scope > [id*="-text_"] > text')) {
      const x = Number(text.getAttribute("x")), y = Number(text.getAttribute("y"));
      if (y < low && y > high) texts.push([text.parentNode, x]);
    }
    const sample = ticks[0], at = sample && Number(sample.querySelector("use").getAttribute("x"));
    let made = [];
    const draw = () => {
      const [a, b] = span || [from, to], k = (to - from) / (b - a), move = x0 - k * (x0 + (a - from) / (to - from) * (x1 - x0));
      const place = x => k * x + move;
      svg.view = [a, b];
      svg.parentNode.classList.toggle("zoomed", span !== null);
      stretched.forEach(one => one.setAttribute("transform", `matrix(${k} 0 0 1 ${move} 0)`));
      texts.forEach(([one, x]) => {
        const shift = place(x) - x;
        one.setAttribute("transform", `translate(${shift} 0)`);
        one.style.display = x + shift < x0 - 1 || x + shift > x1 + 1 ? "none" : "";
      });
      made.forEach(one => one.remove());
      made = [];
      ticks.forEach(one => { one.style.display = span ? "none" : ""; });
      if (!span || !sample) return;
      const step = nice(b - a), digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
      for (let t = Math.ceil(a / step) * step; t <= b; t += step) {
        const one = sample.cloneNode(true);
        one.querySelectorAll("[id]").forEach(part => { if (part.tagName !== "path") part.removeAttribute("id"); });
        one.removeAttribute("id");
        one.style.display = "";
        one.setAttribute("transform", `translate(${x0 + (t - a) / (b - a) * (x1 - x0) - at} 0)`);
        one.querySelectorAll("[clip-path]").forEach(part => part.removeAttribute("clip-path"));
        one.querySelector("text").textContent = t.toFixed(digits).replace("-", "−");
        axis.append(one);
        made.push(one);
      }
    };
    svg.view = [from, to];
    timed.push(draw);
    return {
      zoom: (x, factor) => {
        const [a, b] = span || [from, to], t = a + (x - x0) / (x1 - x0) * (b - a);
        const length = Math.max(LEAST * (to - from), (b - a) / factor);
        const left = t - (t - a) / (b - a) * length;
        show(length >= to - from ? null : [Math.max(from, Math.min(left, to - length)), Math.max(from, Math.min(left, to - length)) + length]);
      },
      pan: dx => {
        if (!span) return;
        const [a, b] = span, left = Math.max(from, Math.min(a - dx / (x1 - x0) * (b - a), to - (b - a)));
        show([left, left + b - a]);
      },
      reset: () => show(null),
    };
  };
  const show = next => {
    span = next;
    timed.forEach(draw => draw());
    document.dispatchEvent(new Event("view"));
  };

  const inFrame = svg => {
    const all = svg.viewBox.baseVal, [w, h] = [all.width, all.height];
    const set = (x, y, width) => {
      const height = width * h / w;
      svg.setAttribute("viewBox", [Math.max(0, Math.min(x, w - width)), Math.max(0, Math.min(y, h - height)), width, height].join(" "));
      svg.parentNode.classList.toggle("zoomed", width < w);
    };
    return {
      zoom: (x, factor, y) => {
        const now = svg.viewBox.baseVal, width = Math.min(w, Math.max(w / 50, now.width / factor)), part = width / now.width;
        set(x - (x - now.x) * part, y - (y - now.y) * part, width);
      },
      pan: (dx, dy) => set(svg.viewBox.baseVal.x - dx, svg.viewBox.baseVal.y - dy, svg.viewBox.baseVal.width),
      reset: () => set(0, 0, w),
    };
  };

  for (const svg of document.querySelectorAll("figure svg")) {
    const view = svg.dataset.time ? overTime(svg) : inFrame(svg);
    const scale = () => svg.viewBox.baseVal.width / svg.getBoundingClientRect().width;
    const onto = event => {
      const box = svg.getBoundingClientRect(), now = svg.viewBox.baseVal;
      return [now.x + (event.clientX - box.left) * scale(), now.y + (event.clientY - box.top) * scale()];
    };
    const fingers = new Map();
    let moved = 0, clicked = false;
    const hint = shown => svg.parentNode.classList.toggle("hint", shown);
    svg.addEventListener("wheel", event => {
      const zooms = clicked || event.ctrlKey || event.metaKey;
      hint(!zooms);
      if (!zooms) return; // the wheel scrolls the page
      event.preventDefault();
      const [x, y] = onto(event);
      view.zoom(x, Math.exp(-event.deltaY / 400), y);
    }, {passive: false});
    svg.addEventListener("pointerleave", () => { clicked = false; hint(false); });
    svg.addEventListener("dblclick", () => view.reset());
    svg.addEventListener("pointerdown", event => {
      fingers.set(event.pointerId, event);
      moved = 0;
      clicked = true;
      hint(false);
    });
    svg.addEventListener("pointermove", event => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
      fingers.set(event.pointerId, event);
      moved += Math.abs(event.clientX - before.clientX) + Math.abs(event.clientY - before.clientY);
      if (moved > 4 && !svg.hasPointerCapture(event.pointerId)) svg.setPointerCapture(event.pointerId);
      if (other) {
        const apart = one => Math.hypot(one.clientX - other.clientX, one.clientY - other.clientY) || 1;
        const [x, y] = onto({clientX: (event.clientX + other.clientX) / 2, clientY: (event.clientY + other.clientY) / 2});
        view.zoom(x, apart(event) / apart(before), y);
      } else if (moved > 4) {
        view.pan((event.clientX - before.clientX) * scale(), (event.clientY - before.clientY) * scale());
      }
    });
    for (const end of ["pointerup", "pointercancel"]) svg.addEventListener(end, event => fingers.delete(event.pointerId));
    // The end of a drag is no click.
    svg.addEventListener("click", event => { if (moved > 4) event.stopImmediatePropagation(); }, true);
  }
})();

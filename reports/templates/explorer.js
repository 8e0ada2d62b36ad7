(() => {
  "use strict";
  const root = document.getElementById("explorer");
  const data = JSON.parse(document.getElementById("explorer-data").textContent);
  const SVG = "http://www.w3.org/2000/svg";
  const W = 640, H = 420, L = 62, R = 12, T = 12, B = 46;
  const plot = root.querySelector(".explorer-plot"), tip = root.querySelector(".explorer-tip");
  const detail = root.querySelector(".explorer-detail"), number = root.querySelector("input");
  const [xs, ys] = root.querySelectorAll("select");
  const withImages = new Set(data.with_images);
  const known = (v) => v !== null && v !== undefined;
  const text = (v) => (known(v) ? String(v).replace("-", "\u2212") : "\u2013");
  const make = (parent, name, attributes, content) => {
    const node = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    if (content !== undefined) node.textContent = content;
    parent.appendChild(node);
    return node;
  };
  const line = (parent, name, content) => {
    const node = document.createElement(name);
    node.textContent = content;
    parent.appendChild(node);
    return node;
  };
  data.labels.forEach((name, k) => {
    for (const [select, at] of [[xs, data.axes[0]], [ys, data.axes[1]]]) {
      const option = line(select, "option", name);
      option.value = k;
      option.selected = k === at;
    }
  });
  const kind = (k) => {
    const value = data.columns[data.metric][k];
    if (!known(value)) return "none";
    return data.bound !== null && Math.abs(value) > data.bound ? "beyond" : "within";
  };
  const ticks = (low, high) => {
    const raw = (high - low) / 7, power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw);
    const values = [];
    for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) values.push(Number(v.toPrecision(6)));
    return values;
  };
  const span = (column) => {
    const values = data.columns[column].filter(known);
    if (!values.length) return [0, 1];
    let low = Math.min(...values), high = Math.max(...values);
    if (low === high) { low -= 0.5; high += 0.5; }
    return [low - 0.04 * (high - low), high + 0.04 * (high - low)];
  };
  let positions = [];
  const draw = () => {
    const x = Number(xs.value), y = Number(ys.value);
    let [x0, x1] = span(x), [y0, y1] = span(y);
    const round = data.parts.length === 2 && data.parts.includes(x) && data.parts.includes(y) && x !== y;
    if (round) {
      const reach = Math.max(...[x0, x1, y0, y1].map(Math.abs), data.bound !== null ? 1.05 * data.bound : 0);
      [x0, x1, y0, y1] = [-reach, reach, -reach, reach];
    }
    const size = round ? Math.min(W - L - R, H - T - B) : 0;
    const w = round ? size : W - L - R, h = round ? size : H - T - B;
    const px = (v) => L + (v - x0) / (x1 - x0) * w, py = (v) => T + h - (v - y0) / (y1 - y0) * h;
    plot.replaceChildren();
    for (const v of ticks(x0, x1)) {
      make(plot, "line", {x1: px(v), x2: px(v), y1: T, y2: T + h, class: "gridline"});
      make(plot, "text", {x: px(v), y: T + h + 16, class: "tick middle"}, text(v));
    }
    for (const v of ticks(y0, y1)) {
      make(plot, "line", {x1: L, x2: L + w, y1: py(v), y2: py(v), class: "gridline"});
      make(plot, "text", {x: L - 6, y: py(v) + 4, class: "tick end"}, text(v));
    }
    make(plot, "text", {x: L + w / 2, y: T + h + 36, class: "tick middle"}, data.labels[x]);
    make(plot, "text", {transform: `translate(14 ${T + h / 2}) rotate(-90)`, class: "tick middle"}, data.labels[y]);
    if (data.bound !== null) {
      if (round) make(plot, "circle", {cx: px(0), cy: py(0), r: data.bound / (x1 - x0) * w, class: "bound"});
      else if (y === data.metric && data.bound <= y1) {
        make(plot, "line", {x1: L, x2: L + w, y1: py(data.bound), y2: py(data.bound), class: "bound"});
      }
    }
    const dots = make(plot, "g", {});
    positions = data.cases.map((_, k) => {
      const vx = data.columns[x][k], vy = data.columns[y][k], what = kind(k);
      if (!known(vx)) return null;
      const at = [px(vx), known(vy) ? py(vy) : T + 4];
      if (!known(vy) || what === "none") make(dots, "path", {d: `M${at[0]} ${at[1] - 5}v10`, class: "point none", "data-k": k});
      else if (what === "beyond") {
        make(dots, "path", {d: `M${at[0]} ${at[1] - 5}l5 9h-10z`, class: "point beyond", "data-k": k});
      } else make(dots, "circle", {cx: at[0], cy: at[1], r: 3.5, class: "point within", "data-k": k});
      return at;
    });
  };
  const nearest = (event) => {
    const box = plot.getBoundingClientRect();
    const x = (event.clientX - box.left) * W / box.width, y = (event.clientY - box.top) * H / box.height;
    let best = -1, minSquaredDistance = 400;
    positions.forEach((at, k) => {
      if (!at) return;
      const d = (at[0] - x) ** 2 + (at[1] - y) ** 2;
      if (d < minSquaredDistance) { minSquaredDistance = d; best = k; }
    });
    return best;
  };
  const open = (k) => {
    detail.replaceChildren();
    plot.querySelector(".selected")?.remove();
    if (k < 0) { line(detail, "p", "No such case among the points."); return; }
    if (positions[k]) make(plot, "circle", {cx: positions[k][0], cy: positions[k][1], r: 9, class: "selected"});
    number.value = data.cases[k];
    line(detail, "h3", `Case ${data.cases[k]}: ${data.outcomes[data.outcome[k]]}`);
    const list = document.createElement("dl");
    data.labels.forEach((name, c) => {
      const pair = document.createElement("div");
      line(pair, "dt", name);
      line(pair, "dd", text(data.columns[c][k]));
      list.appendChild(pair);
    });
    detail.appendChild(list);
    const command = line(detail, "p", "Run it again: ");
    line(command, "code", data.replay.replace(/CASE$/, data.cases[k]));
    if (withImages.has(data.cases[k])) {
      const link = line(line(detail, "p", ""), "a", "Images of the case");
      link.href = `#case-${data.cases[k]}`;
    }
  };
  plot.addEventListener("pointermove", (event) => {
    const k = nearest(event);
    tip.hidden = k < 0;
    if (k < 0) return;
    const value = data.columns[data.metric][k];
    tip.textContent = `Case ${data.cases[k]}: ${data.outcomes[data.outcome[k]]}, ${data.labels[data.metric]} ${text(value)}`;
    const box = plot.parentElement.getBoundingClientRect();
    tip.style.left = `${Math.min(event.clientX - box.left + 12, Math.max(0, box.width - tip.offsetWidth))}px`;
    tip.style.top = `${event.clientY - box.top + 14}px`;
  });
  plot.addEventListener("pointerleave", () => { tip.hidden = true; });
  plot.addEventListener("click", (event) => { const k = nearest(event); if (k >= 0) open(k); });
  root.querySelector("form").addEventListener("submit", (event) => {
    event.preventDefault();
    open(data.cases.indexOf(Number(number.value)));
  });
  for (const select of [xs, ys]) select.addEventListener("change", draw);
  root.hidden = false;
  draw();
})();

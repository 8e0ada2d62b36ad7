(() => {
  "use strict";
  const root = document.getElementById("explorer");
  const data = JSON.parse(document.getElementById("explorer-data").textContent);
  const SVG = "http://www.w3.org/2000/svg";
  const W = 520, H = 360, L = 62, R = 12, T = 12, B = 46, NEAR = 400;
  const VIOLATED = 1, NOT_COUNTED = 2;
  const tip = root.querySelector(".explorer-tip"), detail = root.querySelector(".explorer-detail");
  const number = root.querySelector("input[type=number]"), selection = root.querySelector(".explorer-selection");
  const colour = root.querySelector("select[name=colour]"), filter = root.querySelector("select[name=outcome]");
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
  const addOptions = (select, names, selected) => names.forEach((name, k) => {
    const option = line(select, "option", name);
    option.value = k;
    option.selected = k === selected;
  });
  const ticks = (low, high) => {
    const raw = (high - low) / 6, power = 10 ** Math.floor(Math.log10(raw));
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
  const requirement = () => data.requirements[Number(colour.value)];
  const status = (k) => (requirement() ? requirement().status[k] : 0);
  const shown = (k) => filter.value === "all" || data.outcome[k] === Number(filter.value);
  let selected = null, opened = -1;

  // A plot of one column against another; both plots show the same cases, selected cases are marked in both.
  const createPlot = (container, axes) => {
    const [xs, ys] = container.querySelectorAll("select");
    const plot = container.querySelector("svg");
    addOptions(xs, data.labels, axes[0]);
    addOptions(ys, data.labels, axes[1]);
    let positions = [], start = null, box = null;
    const draw = () => {
      const x = Number(xs.value), y = Number(ys.value), item = requirement();
      let [x0, x1] = span(x), [y0, y1] = span(y);
      const round = data.parts.length === 2 && data.parts.includes(x) && data.parts.includes(y) && x !== y;
      const limit = item && item.column !== null ? item.bound : null;
      if (round) {
        const reach = Math.max(...[x0, x1, y0, y1].map(Math.abs), limit !== null ? 1.05 * limit : 0);
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
      if (limit !== null) {
        if (round && item.column === data.metric) {
          make(plot, "circle", {cx: px(0), cy: py(0), r: limit / (x1 - x0) * w, class: "bound"});
        } else if (y === item.column && limit <= y1) {
          make(plot, "line", {x1: L, x2: L + w, y1: py(limit), y2: py(limit), class: "bound"});
        } else if (x === item.column && limit <= x1) {
          make(plot, "line", {x1: px(limit), x2: px(limit), y1: T, y2: T + h, class: "bound"});
        }
      }
      const dots = make(plot, "g", {});
      positions = data.cases.map((_, k) => {
        const vx = data.columns[x][k], vy = data.columns[y][k];
        if (!known(vx) || !shown(k)) return null;
        const at = [px(vx), known(vy) ? py(vy) : T + 4];
        const faded = selected && !selected.has(k) ? " faded" : "";
        if (!known(vy) || status(k) === NOT_COUNTED) {
          make(dots, "path", {d: `M${at[0]} ${at[1] - 5}v10`, class: `point none${faded}`});
        } else if (status(k) === VIOLATED) {
          make(dots, "path", {d: `M${at[0]} ${at[1] - 5}l5 9h-10z`, class: `point beyond${faded}`});
        } else make(dots, "circle", {cx: at[0], cy: at[1], r: 3.5, class: `point within${faded}`});
        return at;
      });
      if (opened >= 0 && positions[opened]) {
        make(plot, "circle", {cx: positions[opened][0], cy: positions[opened][1], r: 9, class: "selected"});
      }
    };
    const locate = (event) => {
      const area = plot.getBoundingClientRect();
      return [(event.clientX - area.left) * W / area.width, (event.clientY - area.top) * H / area.height];
    };
    const nearest = ([x, y]) => {
      let best = -1, minimum = NEAR;
      positions.forEach((at, k) => {
        const d = at ? (at[0] - x) ** 2 + (at[1] - y) ** 2 : Infinity;
        if (d < minimum) { minimum = d; best = k; }
      });
      return best;
    };
    plot.addEventListener("pointerdown", (event) => { start = locate(event); plot.setPointerCapture(event.pointerId); });
    plot.addEventListener("pointermove", (event) => {
      const at = locate(event), k = nearest(at);
      if (start && Math.hypot(at[0] - start[0], at[1] - start[1]) > 6) {
        box?.remove();
        const [left, top] = [0, 1].map((i) => Math.min(at[i], start[i]));
        box = make(plot, "rect", {x: left, y: top, width: Math.abs(at[0] - start[0]), height: Math.abs(at[1] - start[1]), class: "brush"});
      }
      tip.hidden = k < 0 || Boolean(box);
      if (tip.hidden) return;
      const name = known(data.metric) ? `, ${data.labels[data.metric]} ${text(data.columns[data.metric][k])}` : "";
      tip.textContent = `Case ${data.cases[k]}: ${data.outcomes[data.outcome[k]]}${name}`;
      const area = tip.parentElement.getBoundingClientRect();
      tip.style.left = `${Math.min(event.clientX - area.left + 12, Math.max(0, area.width - tip.offsetWidth))}px`;
      tip.style.top = `${event.clientY - area.top + 14}px`;
    });
    plot.addEventListener("pointerleave", () => { tip.hidden = true; });
    plot.addEventListener("pointerup", (event) => {
      const at = locate(event), from = start;
      start = null;
      if (!box) { const k = nearest(at); if (k >= 0) open(k); return; }
      box = null;
      const inside = (p) => p && [0, 1].every((i) => p[i] >= Math.min(at[i], from[i]) && p[i] <= Math.max(at[i], from[i]));
      choose(new Set(positions.flatMap((p, k) => (inside(p) ? [k] : []))));
    });
    for (const select of [xs, ys]) select.addEventListener("change", draw);
    return draw;
  };

  const containers = [...root.querySelectorAll(".explorer-canvas")];
  addOptions(colour, data.requirements.map((item) => item.name), 0);
  line(filter, "option", "all").value = "all";
  data.outcomes.forEach((name, k) => { line(filter, "option", name).value = k; });
  const plots = containers.map((container, k) => createPlot(container, data.axes[k]));
  const drawAll = () => plots.forEach((draw) => draw());
  const choose = (cases) => {
    selected = cases && cases.size ? cases : null;
    selection.replaceChildren();
    if (selected) {
      const names = [...selected].slice(0, 12).map((k) => data.cases[k]).join(", ");
      const violated = [...selected].filter((k) => status(k) === VIOLATED).length;
      line(selection, "span", `${selected.size} cases selected, ${violated} violations: ${names}${selected.size > 12 ? ", …" : ""} `);
      const clear = line(selection, "button", "Clear the selection");
      clear.type = "button";
      clear.addEventListener("click", () => choose(null));
    }
    drawAll();
  };
  const open = (k) => {
    detail.replaceChildren();
    opened = k;
    drawAll();
    if (k < 0) { line(detail, "p", "No such case among the points."); return; }
    number.value = data.cases[k];
    line(detail, "h3", `Case ${data.cases[k]}: ${data.outcomes[data.outcome[k]]}`);
    const violated = data.requirements.filter((item) => item.status[k] === VIOLATED).map((item) => item.name);
    if (violated.length) line(detail, "p", `Violates ${violated.join(", ")}.`);
    const command = line(detail, "p", "Run it again: ");
    line(command, "code", data.replay.replace(/CASE$/, data.cases[k]));
    if (withImages.has(data.cases[k])) {
      const link = line(line(detail, "p", ""), "a", "Images of the case");
      link.href = `#case-${data.cases[k]}`;
    }
    const list = document.createElement("dl");
    data.labels.forEach((name, c) => {
      if (!known(data.columns[c][k])) return;
      const pair = document.createElement("div");
      line(pair, "dt", name);
      line(pair, "dd", text(data.columns[c][k]));
      list.appendChild(pair);
    });
    detail.appendChild(list);
  };
  root.querySelector("form").addEventListener("submit", (event) => {
    event.preventDefault();
    open(data.cases.indexOf(Number(number.value)));
  });
  colour.addEventListener("change", drawAll);
  filter.addEventListener("change", drawAll);
  document.addEventListener("keydown", (event) => { if (event.key === "Escape" && selected) choose(null); });
  root.hidden = false;
  drawAll();
})();

(() => {
  "use strict";
  const verdicts = JSON.parse(document.getElementById("verdicts").textContent);
  const form = document.getElementById("filter"), count = document.getElementById("count");
  const campaigns = [...document.querySelectorAll(".campaigns tbody tr")];
  const requirements = [...document.querySelectorAll(".requirements tbody tr")];
  const badges = new Map();
  for (const node of document.querySelectorAll(".badge")) badges.set(node.textContent.trim(), node);
  const matches = (row, filter) =>
    ["system", "site", "algorithm", "commit", "evidence"].every(
      (key) => !filter[key] || row.dataset[key].split("\n").includes(filter[key])) &&
    (!filter.from || row.dataset.date >= filter.from) && (!filter.until || row.dataset.date <= filter.until) &&
    (!filter.text || row.dataset.text.toLowerCase().includes(filter.text.toLowerCase()));
  const SVG = "http://www.w3.org/2000/svg", LATEST = 24, MAX_OTHER = 7, W = 120, H = 26;
  const add = (parent, name, attributes) => {
    const node = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    parent.append(node);
  };
  // as `reports.dashboard.entries.sparkline`
  const drawSparkline = (cells) => {
    const finished = cells.filter((cell) => cell.finished && cell.name === cells[0].name && cell.confirmation === cells[0].confirmation && cell.rate !== null && cell.required !== null);
    const latestCells = finished.slice(0, LATEST).reverse();
    if (latestCells.length < 2) return [];
    let low = Math.min(...latestCells.flatMap((cell) => [cell.rate, cell.required]));
    low -= 0.15 * (1 - low) + 1e-9;
    const height = (rate) => 3 + (H - 6) * (1 - rate) / (1 - low), last = latestCells[latestCells.length - 1];
    const points = latestCells.map((cell, k) => [4 + (W - 8) / (latestCells.length - 1) * k, height(cell.rate)]);
    const figure = document.createElementNS(SVG, "svg");
    figure.setAttribute("class", "spark");
    figure.setAttribute("viewBox", `0 0 ${W} ${H}`);
    figure.setAttribute("role", "img");
    figure.setAttribute("aria-label", `${latestCells.length} campaigns, rates ${latestCells[0].rate_text} to ${last.rate_text}`);
    add(figure, "line", {x1: 0, x2: W, y1: height(last.required), y2: height(last.required)});
    add(figure, "polyline", {points: points.map((at) => at.join()).join(" ")});
    add(figure, "circle", {cx: points[points.length - 1][0], cy: points[points.length - 1][1], r: 2.6});
    return [figure];
  };
  const statusClass = (status) =>
    status.startsWith("PASS (") ? "status-met-by-rate" : `status-${status.toLowerCase().replaceAll(" ", "-")}`;
  const updateRow = (row, cells) => {
    const verdict = row.querySelector(".verdict");
    if (!verdict) return;
    const [evidence, margin, campaignCount] = ["evidence", "margin", "campaign-count"].map((name) => row.querySelector(`.${name}`));
    const latest = cells[0];
    verdict.className = `verdict ${statusClass(latest ? latest.status : "NO CAMPAIGN")}`;
    const badge = latest && badges.get(latest.status);
    if (badge) {
      const basis = document.createElement("span");
      basis.className = "detail";
      basis.textContent = latest.basis;
      verdict.replaceChildren(badge.cloneNode(true), basis);
    }
    else verdict.textContent = latest ? latest.status : "no campaign fits";
    const list = document.createElement("ul"), names = new Set();
    for (const cell of cells) {
      if (names.has(cell.name) || names.size > MAX_OTHER) continue;
      names.add(cell.name);
      const [item, detail, word, link, date] = ["li", "span", "b", "a", "span"].map((name) => document.createElement(name));
      item.textContent = cell.evidence;
      detail.className = "detail";
      word.className = statusClass(cell.status);
      word.textContent = cell.status;
      link.href = `c/${cell.slug}/index.html`;
      link.textContent = cell.name;
      date.className = "date";
      date.textContent = cell.date;
      detail.append(...(names.size > 1 ? [word, " "] : []), link, ", ", date, cell.algorithm ? `, ${cell.algorithm}` : "", cell.kind ? `, ${cell.kind}` : "", cell.finished ? "" : ", not finished");
      item.append(detail);
      list.append(item);
    }
    evidence.replaceChildren(...(latest ? [list] : ["\u2013"]));
    row.querySelector(".trend").replaceChildren(...(latest ? drawSparkline(cells) : []));
    margin.textContent = latest ? latest.margin : "\u2013";
    campaignCount.textContent = cells.length.toLocaleString("en");
  };
  const apply = () => {
    const filter = Object.fromEntries(new FormData(form)), visible = new Set();
    for (const row of campaigns) {
      row.hidden = !matches(row, filter);
      if (!row.hidden) visible.add(row.id);
    }
    for (const row of requirements) {
      updateRow(row, (verdicts[row.dataset.requirement] || []).filter((cell) => visible.has(cell.slug)));
    }
    count.textContent = `${visible.size.toLocaleString("en")} of ${campaigns.length.toLocaleString("en")} campaigns`;
  };
  form.addEventListener("input", apply);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => setTimeout(apply));
  // apply the filter that the browser restores after a reload or on the way back
  window.addEventListener("pageshow", apply);
})();

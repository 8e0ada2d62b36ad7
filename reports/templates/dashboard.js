(() => {
  "use strict";
  const verdicts = JSON.parse(document.getElementById("verdicts").textContent);
  const form = document.getElementById("filter"), count = document.getElementById("count");
  const campaigns = [...document.querySelectorAll(".campaigns tbody tr")];
  const requirements = [...document.querySelectorAll(".requirements tbody tr")];
  const badges = new Map();
  for (const node of document.querySelectorAll(".badge")) badges.set(node.textContent.trim(), node);
  const fits = (row, asked) =>
    ["system", "site", "algorithm", "commit", "evidence"].every(
      (key) => !asked[key] || row.dataset[key].split("\n").includes(asked[key])) &&
    (!asked.from || row.dataset.date >= asked.from) && (!asked.until || row.dataset.date <= asked.until) &&
    (!asked.text || row.dataset.text.toLowerCase().includes(asked.text.toLowerCase()));
  const SVG = "http://www.w3.org/2000/svg", LATEST = 24, BESIDE = 7, W = 120, H = 26;
  const add = (parent, name, attributes) => {
    const node = document.createElementNS(SVG, name);
    for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
    parent.append(node);
  };
  // as `reports.dashboard.rows.sparkline` draws it of all campaigns
  const spark = (found) => {
    const known = found.filter((one) => one.finished && one.name === found[0].name && one.rate !== null && one.asked !== null);
    const shown = known.slice(0, LATEST).reverse();
    if (shown.length < 2) return [];
    let low = Math.min(...shown.flatMap((one) => [one.rate, one.asked]));
    low -= 0.15 * (1 - low) + 1e-9;
    const height = (rate) => 3 + (H - 6) * (1 - rate) / (1 - low), last = shown[shown.length - 1];
    const places = shown.map((one, k) => [4 + (W - 8) / (shown.length - 1) * k, height(one.rate)]);
    const drawn = document.createElementNS(SVG, "svg");
    drawn.setAttribute("class", "spark");
    drawn.setAttribute("viewBox", `0 0 ${W} ${H}`);
    drawn.setAttribute("role", "img");
    drawn.setAttribute("aria-label", `${shown.length} campaigns, rates ${shown[0].rate_text} to ${last.rate_text}`);
    add(drawn, "line", {x1: 0, x2: W, y1: height(last.asked), y2: height(last.asked)});
    add(drawn, "polyline", {points: places.map((at) => at.join()).join(" ")});
    add(drawn, "circle", {cx: places[places.length - 1][0], cy: places[places.length - 1][1], r: 2.6});
    return [drawn];
  };
  const statusClass = (status) => `status-${status.toLowerCase().replaceAll(" ", "-")}`;
  const show = (row, found) => {
    const verdict = row.querySelector(".verdict");
    if (!verdict) return;
    const [evidence, margin, shown] = ["evidence", "margin", "shown"].map((name) => row.querySelector(`.${name}`));
    const latest = found[0];
    verdict.className = `verdict ${statusClass(latest ? latest.status : "NO CAMPAIGN")}`;
    const badge = latest && badges.get(latest.status);
    if (badge) {
      const basis = document.createElement("span");
      basis.className = "asked";
      basis.textContent = latest.basis;
      verdict.replaceChildren(badge.cloneNode(true), basis);
    }
    else verdict.textContent = "no campaign fits";
    const list = document.createElement("ul"), names = new Set();
    for (const one of found) {
      if (names.has(one.name) || names.size > BESIDE) continue;
      names.add(one.name);
      const [item, about, word, link, date] = ["li", "span", "b", "a", "span"].map((name) => document.createElement(name));
      item.textContent = one.evidence;
      about.className = "asked";
      word.className = statusClass(one.status);
      word.textContent = one.status;
      link.href = `c/${one.slug}/index.html`;
      link.textContent = one.name;
      date.className = "date";
      date.textContent = one.date;
      about.append(...(names.size > 1 ? [word, " "] : []), link, ", ", date, one.algorithm ? `, ${one.algorithm}` : "", one.kind ? `, ${one.kind}` : "", one.finished ? "" : ", not finished");
      item.append(about);
      list.append(item);
    }
    evidence.replaceChildren(...(latest ? [list] : ["\u2013"]));
    row.querySelector(".trend").replaceChildren(...(latest ? spark(found) : []));
    margin.textContent = latest ? latest.margin : "\u2013";
    shown.textContent = found.length.toLocaleString("en");
  };
  const apply = () => {
    const asked = Object.fromEntries(new FormData(form)), left = new Set();
    for (const row of campaigns) {
      row.hidden = !fits(row, asked);
      if (!row.hidden) left.add(row.id);
    }
    for (const row of requirements) {
      show(row, (verdicts[row.dataset.requirement] || []).filter((one) => left.has(one.slug)));
    }
    count.textContent = `${left.size.toLocaleString("en")} of ${campaigns.length.toLocaleString("en")} campaigns`;
  };
  form.addEventListener("input", apply);
  form.addEventListener("submit", (event) => event.preventDefault());
  form.addEventListener("reset", () => setTimeout(apply));
  // what was chosen before a reload or a way back, or before this ran
  window.addEventListener("pageshow", apply);
})();

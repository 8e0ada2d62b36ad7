(() => {
  "use strict";
  const verdicts = JSON.parse(document.getElementById("verdicts").textContent);
  const form = document.getElementById("filter"), count = document.getElementById("count");
  const campaigns = [...document.querySelectorAll(".campaigns tbody tr")];
  const requirements = [...document.querySelectorAll(".requirements tbody tr")];
  const badges = new Map();
  for (const node of document.querySelectorAll(".badge")) badges.set(node.textContent.trim(), node);
  const fits = (row, asked) =>
    ["system", "site", "algorithm", "commit"].every((key) => !asked[key] || row.dataset[key] === asked[key]) &&
    (!asked.from || row.dataset.date >= asked.from) && (!asked.until || row.dataset.date <= asked.until) &&
    (!asked.text || row.dataset.text.toLowerCase().includes(asked.text.toLowerCase()));
  const show = (row, found) => {
    const verdict = row.querySelector(".verdict");
    if (!verdict) return;
    const [evidence, margin, shown] = ["evidence", "margin", "shown"].map((name) => row.querySelector(`.${name}`));
    const latest = found[0];
    verdict.className = `verdict status-${latest ? latest.status.toLowerCase() : "no-campaign"}`;
    const badge = latest && badges.get(latest.status);
    if (badge) verdict.replaceChildren(badge.cloneNode(true));
    else verdict.textContent = "no campaign fits";
    evidence.textContent = latest ? latest.evidence : "\u2013";
    if (latest) {
      const [about, link, date] = ["span", "a", "span"].map((name) => document.createElement(name));
      about.className = "asked";
      link.href = `c/${latest.slug}/index.html`;
      link.textContent = latest.name;
      date.className = "date";
      date.textContent = latest.date;
      about.append(link, ", ", date);
      evidence.append(about);
    }
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

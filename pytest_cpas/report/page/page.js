"use strict";
// The list of samples. Everything from data becomes text of a node, never markup.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const form = document.getElementById("filters");
  const body = document.getElementById("samples");
  const told = document.getElementById("told");
  const more = document.getElementById("more");
  const STEP = 200;
  const KEYS = ["run", "category", "verdict", "at", "order", "name"];
  let shown = STEP;

  const all = data.runs.flatMap((run) =>
    run.samples.map(([sample, category, outcome, golden, position, rotation, iou, fscore, remark, failure, since]) => ({
      run: run.name, sample, category: run.categories[category], outcome, golden, position, rotation, iou, fscore,
      remark, failure, since,
    })));

  const fill = (name, values) => {
    for (const value of values) form.elements[name].add(new Option(value, value));
  };
  fill("run", data.runs.map((run) => run.name));
  fill("category", [...new Set(all.map((s) => s.category))].sort());
  fill("at", data.thresholds);

  const verdicts = {
    "lost": (s, i) => s.golden && s.outcome && s.golden[i] === "1" && s.outcome[i] === "0",
    "gained": (s, i) => s.golden && s.outcome && s.golden[i] === "0" && s.outcome[i] === "1",
    "not correct": (s, i) => s.outcome && s.outcome[i] === "0",
    "correct": (s, i) => s.outcome && s.outcome[i] === "1",
    "no answer": (s) => s.outcome && s.failure,
    "not judged": (s) => !s.outcome,
  };
  if (data.against) {
    verdicts["lost since"] = (s, i) => s.since && s.since[i] === "-";
    verdicts["gained since"] = (s, i) => s.since && s.since[i] === "+";
  }
  fill("verdict", Object.keys(verdicts));

  const chosen = () => {
    const value = Object.fromEntries(KEYS.map((key) => [key, form.elements[key].value]));
    const at = value.at ? [data.thresholds.indexOf(value.at)] : data.thresholds.map((_, i) => i);
    const some = value.verdict !== "correct";
    const name = value.name.toLowerCase();
    const kept = all.filter((s) =>
      (!value.run || s.run === value.run) &&
      (!value.category || s.category === value.category) &&
      (!name || s.sample.toLowerCase().includes(name)) &&
      (!value.verdict || (some
        ? at.some((i) => verdicts[value.verdict](s, i))
        : at.every((i) => verdicts.correct(s, i) || (s.outcome && s.outcome[i] === "-")))));
    if (value.order === "worst") {
      const met = (s) => s.outcome ? [...s.outcome].filter((c) => c === "1").length : -1;
      const size = (x) => x === null ? Infinity : x;
      // the errors at which a threshold is as hard in one as in the other: 10 deg, 2 cm
      const error = (s) => Math.max(size(s.position) / 0.02, size(s.rotation) / 10);
      const scored = kept.map((s) => [met(s), error(s), s]);
      scored.sort((a, b) => a[0] - b[0] || (b[1] === a[1] ? 0 : b[1] - a[1]));
      return scored.map((x) => x[2]);
    }
    return kept;
  };

  const cell = (row, text, kind) => {
    const td = row.insertCell();
    td.textContent = text;
    if (kind) td.className = kind;
    return td;
  };
  const marks = (row, outcome) => {
    const td = cell(row, "", "outcome");
    for (const [i, c] of [...(outcome || "")].entries()) {
      const span = document.createElement("span");
      span.textContent = { "1": "●", "0": "○" }[c] || "–";
      span.className = { "1": "met", "0": "unmet" }[c] || "faint";
      span.title = data.thresholds[i] + ": " + ({ "1": "correct", "0": "not correct" }[c] || "n/a");
      td.append(span);
    }
  };
  const number = (x, factor, digits) => x === null ? "–" : (factor * x).toFixed(digits);

  const draw = () => {
    const kept = chosen();
    const rows = document.createDocumentFragment();
    for (const s of kept.slice(0, shown)) {
      const row = document.createElement("tr");
      cell(row, s.sample);
      cell(row, s.category);
      marks(row, s.outcome);
      marks(row, s.golden);
      cell(row, number(s.position, 100, 2), "number");
      cell(row, number(s.rotation, 1, 2), "number");
      cell(row, number(s.iou, 1, 3), "number");
      cell(row, number(s.fscore, 1, 3), "number");
      if (data.runs.length > 1) cell(row, s.run);
      cell(row, s.remark || "", "wrap");
      rows.append(row);
    }
    body.replaceChildren(rows);
    told.textContent = `${kept.length} of ${all.length} samples`;
    more.hidden = kept.length <= shown;
  };

  const toFragment = () => {
    const state = new URLSearchParams();
    for (const key of KEYS) {
      const { value } = form.elements[key];
      if (value) state.set(key, value);
    }
    history.replaceState(null, "", state.toString() ? "#" + state : location.pathname + location.search);
  };
  const fromFragment = () => {
    if (location.hash.length > 1 && !location.hash.includes("=")) return; // a link within the page
    const state = new URLSearchParams(location.hash.slice(1));
    for (const key of KEYS) {
      const field = form.elements[key];
      field.value = state.get(key) || "";
      if (field.selectedIndex === -1) field.value = ""; // of another report
    }
    shown = STEP;
    draw();
  };

  form.addEventListener("input", () => { shown = STEP; toFragment(); draw(); });
  form.addEventListener("submit", (event) => event.preventDefault());
  document.getElementById("clear").addEventListener("click", () => {
    form.reset(); shown = STEP; toFragment(); draw();
  });
  more.addEventListener("click", () => { shown += STEP; draw(); });
  addEventListener("hashchange", () => {
    fromFragment();
    if (location.hash.includes("=")) form.scrollIntoView();
  });
  fromFragment();
  draw();
  if (location.hash.includes("=")) form.scrollIntoView();
})();

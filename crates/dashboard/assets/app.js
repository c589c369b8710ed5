// Asks the server every two seconds and shows what is new.

import { Chart, short, smoothed, summary } from "./chart.js";
import { showLive } from "./live.js";
import { showMedia } from "./show.js";

const PAUSE_MS = 2000;
/** Shown before anybody filters, as far as a run has them. */
const FIRST = ["eval/score", "episode/score", "train/loss/model", "train/loss/image", "train/loss/reward",
  "train/loss/controllable_kl", "train/loss/noncontrollable_kl", "train/mask/noncontrollable", "train/loss/gate",
  "open_loop/error", "probe/rank_correlation", "fps/env", "fps/train"];
/** Runs that are chosen at first, at most. */
const CHOSEN = 12;
const COLORS = 8;

const byId = (id) => document.getElementById(id);
const state = { runs: [], rows: new Map(), chosen: null, shown: null, series: new Map(), charts: new Map(), live: false };

async function ask(path, query = {}) {
  const answer = await fetch(`api/${path}?${new URLSearchParams(query)}`);
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

const color = (index) => getComputedStyle(document.documentElement).getPropertyValue(`--c${index % COLORS}`).trim();
const groups = () => [...new Set(state.runs.map((run) => run.group))].sort();
const chosenRuns = () => state.runs.filter((run) => state.chosen?.has(run.id));

/** Children that are there already stay what they are: somebody may be about to use them. */
function place(area, elements) {
  if (elements.length !== area.childNodes.length || elements.some((element, i) => element !== area.childNodes[i])) {
    area.replaceChildren(...elements);
  }
}

function newRow(id) {
  const row = document.createElement("label");
  row.innerHTML = "<input type='checkbox'><span class='swatch'></span><span class='name'></span>"
    + "<span class='env quiet'></span><span class='progress quiet'></span><span class='score'></span>";
  const box = row.children[0];
  box.addEventListener("change", () => {
    if (box.checked) state.chosen.add(id);
    else state.chosen.delete(id);
    refreshCurves().catch(() => {});
  });
  return row;
}

function runRow(run) {
  if (!state.rows.has(run.id)) state.rows.set(run.id, newRow(run.id));
  const row = state.rows.get(run.id);
  const [box, swatch, name, env, progress, score] = row.children;
  box.checked = state.chosen.has(run.id);
  swatch.style.background = color(lineIndex(run));
  name.textContent = run.id === "." ? "this run" : run.id;
  env.textContent = run.env;
  progress.textContent = `${short(run.frames)} of ${short(run.total_frames)}`;
  const trained = run.evaluation.trained;
  score.textContent = trained ? `${short(trained.return_mean)} ± ${short(trained.return_std)}` : "";
  score.title = "final comparison: mean and standard deviation of the trained policy's returns";
  return row;
}

/** Colours are by group, or by run where each is drawn by itself. */
function lineIndex(run) {
  return byId("by-run").checked ? state.runs.map((other) => other.id).sort().indexOf(run.id) : groups().indexOf(run.group);
}

function showRuns() {
  const sorted = [...state.runs].sort((a, b) => a.group.localeCompare(b.group) || a.seed - b.seed);
  if (sorted.length) place(byId("runs"), sorted.map(runRow));
  else byId("runs").textContent = "There is no run here yet.";
  const select = byId("shown-run");
  // A list that somebody has open stays as it is, unless it says something else.
  const same = select.options.length === sorted.length && sorted.every((run, i) => select.options[i].value === run.id);
  if (!same) select.replaceChildren(...sorted.map((run) => new Option(run.id === "." ? "this run" : run.id, run.id)));
  select.value = state.shown ?? "";
}

function metrics() {
  const known = new Set(chosenRuns().flatMap((run) => run.metrics));
  const filter = byId("filter").value.trim().toLowerCase();
  if (!filter) return FIRST.filter((name) => known.has(name));
  return [...known].filter((name) => name.toLowerCase().includes(filter)).sort().slice(0, 24);
}

function lines(metric) {
  const window = Number(byId("smooth").value);
  const of = (run) => smoothed(state.series.get(`${run.id} ${metric}`)?.points ?? [], window);
  const runs = chosenRuns().filter((run) => run.metrics.includes(metric));
  if (byId("by-run").checked) {
    return runs.map((run) => ({ name: run.id, color: color(lineIndex(run)), points: of(run) }));
  }
  return groups().flatMap((group) => {
    const members = runs.filter((run) => run.group === group);
    if (!members.length) return [];
    const name = members.length > 1 ? `${group}, median of ${members.length}` : group;
    const line = { name: name === "." ? "value" : name, color: color(lineIndex(members[0])) };
    if (members.length === 1) return [{ ...line, points: of(members[0]) }];
    return [{ ...line, ...summary(members.map(of)) }];
  });
}

function showCurves() {
  const wanted = metrics();
  for (const name of wanted) {
    if (!state.charts.has(name)) state.charts.set(name, new Chart(name));
  }
  const elements = wanted.map((name) => state.charts.get(name).element);
  place(byId("charts"), elements);
  wanted.forEach((name) => state.charts.get(name).show(lines(name)));
}

/** Fetches what is shown and has grown since. */
async function refreshCurves() {
  const wanted = metrics();
  const missing = chosenRuns().flatMap((run) => wanted
    .filter((metric) => run.metrics.includes(metric))
    .filter((metric) => state.series.get(`${run.id} ${metric}`)?.written !== run.written)
    .map((metric) => [run, metric]));
  await Promise.all(missing.map(async ([run, metric]) => {
    const { points } = await ask("series", { run: run.id, metric });
    state.series.set(`${run.id} ${metric}`, { points, written: run.written });
  }));
  showCurves();
}

async function refresh() {
  const overview = await ask("runs");
  byId("root").textContent = overview.root;
  state.runs = overview.runs;
  if (overview.runs.length) state.chosen ??= new Set(overview.runs.slice(0, CHOSEN).map((run) => run.id));
  state.shown = overview.runs.some((run) => run.id === state.shown) ? state.shown : overview.runs[0]?.id ?? null;
  showRuns();
  byId("live").hidden = !overview.live;
  const live = overview.live ? ask("live").then(showLive) : null;
  const media = state.shown === null ? null : ask("media", { run: state.shown }).then((found) => showMedia(state.shown, found));
  await Promise.all([live, media, refreshCurves()]);
}

function connection(words, up) {
  const element = byId("connection");
  element.className = up ? "up" : "down";
  if (element.textContent !== words) element.textContent = words;
}

async function forever() {
  for (;;) {
    try {
      if (!document.hidden) await refresh();
      connection("connected", true);
    } catch (error) {
      connection(error instanceof TypeError ? "no answer, trying again" : error.message, false);
    }
    await new Promise((resolve) => setTimeout(resolve, PAUSE_MS));
  }
}

byId("theme").addEventListener("click", () => {
  const root = document.documentElement;
  const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  root.dataset.theme = dark ? "light" : "dark";
  localStorage.setItem("theme", root.dataset.theme);
  showRuns();
  showCurves();
});
const theme = localStorage.getItem("theme");
if (theme) document.documentElement.dataset.theme = theme;
byId("smooth").addEventListener("input", () => {
  byId("smooth-value").value = byId("smooth").value;
  showCurves();
});
byId("by-run").addEventListener("change", () => {
  showRuns();
  showCurves();
});
byId("filter").addEventListener("input", () => refreshCurves().catch(() => {}));
byId("shown-run").addEventListener("change", (event) => {
  state.shown = event.target.value;
  ask("media", { run: state.shown }).then((found) => showMedia(state.shown, found)).catch(() => {});
});
forever();

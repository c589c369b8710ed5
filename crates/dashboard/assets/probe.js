// A probe of the world model: imagined over real returns, and how well they agree.

import { node, short, ticks } from "./chart.js";

const HEIGHT = 240;
const MARGIN = { left: 46, right: 10, top: 8, bottom: 34 };

const byId = (id) => document.getElementById(id);
const color = (index) => getComputedStyle(document.documentElement).getPropertyValue(`--c${index % 8}`).trim();
const fixed = (value) => (value === null ? "-" : value.toFixed(2));
const kinds = (facts) => Object.keys(facts.kinds);

function rows(table, lists) {
  table.replaceChildren(...lists.map((list) => {
    const row = document.createElement("tr");
    row.replaceChildren(...list.map((text) => {
      const cell = document.createElement("td");
      cell.textContent = text;
      return cell;
    }));
    return row;
  }));
}

/** All states, then each kind; a kind alone is all. */
function groups(facts) {
  const named = kinds(facts).map((kind) => [kind, facts.kinds[kind]]);
  return named.length > 1 ? [["all", facts.all], ...named] : [["all", facts.all]];
}

function points(facts) {
  const area = byId("probe-points");
  const svg = node("svg", { role: "img", "aria-label": "imagined over real returns" }, null);
  area.replaceChildren(svg);
  const width = svg.clientWidth || 400;
  const values = facts.states.flatMap((state) => [...state.real, ...state.imagined]);
  let [low, high] = [Math.min(...values), Math.max(...values)];
  const room = (high - low || 1) * 0.06;
  [low, high] = [low - room, high + room];
  const part = (value) => (value - low) / (high - low);
  const x = (value) => MARGIN.left + part(value) * (width - MARGIN.left - MARGIN.right);
  const y = (value) => HEIGHT - MARGIN.bottom - part(value) * (HEIGHT - MARGIN.top - MARGIN.bottom);
  for (const [tick, words] of ticks(low, high, 4)) {
    node("line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: y(tick), y2: y(tick) }, svg);
    node("text", { x: MARGIN.left - 6, y: y(tick) + 4, "text-anchor": "end" }, svg, words);
    node("text", { x: x(tick), y: HEIGHT - MARGIN.bottom + 14, "text-anchor": "middle" }, svg, words);
  }
  node("line", { class: "right", x1: x(low), y1: y(low), x2: x(high), y2: y(high) }, svg);
  const names = kinds(facts);
  for (const state of facts.states) {
    const fill = color(names.indexOf(state.kind));
    state.real.forEach((real, plan) => {
      const dot = node("circle", { class: "probed", cx: x(real), cy: y(state.imagined[plan]), r: 3, fill }, svg);
      const words = `${facts.plans[plan]}: real ${short(real)}, imagined ${short(state.imagined[plan])}`;
      node("title", {}, dot, names.length > 1 ? `${state.kind}, ${words}` : words);
    });
  }
  const legend = node("text", { x: MARGIN.left, y: HEIGHT - 2 }, svg, "imagined over real return");
  for (const name of names.length > 1 ? names : []) {
    const word = node("tspan", { dx: 10 }, legend, name);
    word.style.fill = color(names.indexOf(name));
  }
}

/** Shows `media/probe-*.json`. */
export function showProbe(facts) {
  points(facts);
  const scores = byId("probe-scores").tBodies[0];
  rows(scores, groups(facts).map(([name, found]) => [name, found.states, fixed(found.rank_correlation), fixed(found.bias)]));
  const plans = byId("probe-plans");
  rows(plans.tHead, [["plan", ...groups(facts).map(([name]) => name)]]);
  rows(plans.tBodies[0], facts.plans.map((plan, index) => [
    plan, ...groups(facts).map(([, found]) => `${fixed(found.real[index])} / ${fixed(found.imagined[index])}`),
  ]));
}

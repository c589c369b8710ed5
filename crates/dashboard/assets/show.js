// Episodes, open-loop panels and probes of the world model: videos, what lies beneath them in time, and tables.

import { Chart, short } from "./chart.js";
import { showProbe } from "./probe.js";

const byId = (id) => document.getElementById(id);
const padded = (frames) => String(frames).padStart(10, "0");
const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

/** Dark to light, so that it also reads in gray: the scale of the panels. */
const HEAT = [[0, 0, 8], [66, 10, 104], [147, 38, 103], [221, 81, 58], [252, 165, 10], [252, 255, 164]];

function heat(value) {
  const place = Math.max(0, Math.min(1, value)) * (HEAT.length - 1);
  const low = Math.min(Math.floor(place), HEAT.length - 2);
  return HEAT[low].map((from, i) => from + (HEAT[low + 1][i] - from) * (place - low));
}

/** Cells `[rows][steps]` in [0, 1], beneath a video and on its time. */
function strip(title, about, rows, height, video, facts) {
  const made = document.createElement("div");
  made.className = "strip";
  made.innerHTML = "<h3></h3><p></p><div class='place'><canvas></canvas><div class='now'></div></div>";
  [made.children[0].textContent, made.children[1].textContent] = [title, about];
  const [canvas, now] = made.children[2].children;
  [canvas.width, canvas.height] = [rows[0].length, rows.length];
  canvas.style.height = `${height}px`;
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", title);
  const context = canvas.getContext("2d");
  const picture = context.createImageData(canvas.width, canvas.height);
  rows.forEach((row, y) => row.forEach((value, x) => {
    picture.data.set([...heat(value), 255], 4 * (y * canvas.width + x));
  }));
  context.putImageData(picture, 0, 0);
  const length = (facts.length + 1) / facts.fps;
  canvas.addEventListener("click", (event) => {
    video.currentTime = (event.offsetX / canvas.clientWidth) * length;
  });
  const follow = () => {
    if (!made.isConnected) return;
    now.style.left = `${(100 * video.currentTime) / length}%`;
    requestAnimationFrame(follow);
  };
  requestAnimationFrame(follow);
  return made;
}

/** Columns become rows; weights are drawn against the greatest one. */
function attentionRows(attention) {
  const most = Math.max(...attention.flat());
  return attention[0].map((_, step) => attention.map((weights) => weights[step] / most));
}

/** One kind of media: a slider over all there are, which stays at the newest until it is moved. */
class Shelf {
  constructor(kind, prefix, show) {
    Object.assign(this, { kind, show, frames: [], shown: null, run: null });
    this.figure = byId(prefix);
    this.slider = byId(`${prefix}-at`);
    this.slider.addEventListener("input", () => this.open(Number(this.slider.value)));
  }

  file(frames, extension) {
    return `api/file?run=${encodeURIComponent(this.run)}&name=${this.kind}-${padded(frames)}.${extension}`;
  }

  fill(run, frames) {
    const follows = run !== this.run || Number(this.slider.value) >= this.frames.length - 1;
    [this.run, this.frames] = [run, frames];
    this.figure.hidden = !frames.length;
    this.slider.max = Math.max(0, frames.length - 1);
    this.slider.disabled = frames.length < 2;
    if (frames.length && follows) this.open(frames.length - 1);
  }

  async open(index) {
    const key = `${this.run} ${this.frames[index]}`;
    this.slider.value = index;
    if (key === this.shown) return;
    this.shown = key;
    const facts = await fetch(this.file(this.frames[index], "json"))
      .then((answer) => (answer.ok ? answer.json() : null))
      .catch(() => null);
    if (this.shown !== key) return;
    if (facts) this.show(this, facts, this.frames[index]);
    // The next round asks again.
    else this.shown = null;
  }
}

function caption(element, strong, rest) {
  const word = document.createElement("strong");
  word.textContent = strong;
  element.replaceChildren(word, ` ${rest}`);
}

function play(video, source) {
  video.src = source;
  video.play().catch(() => {});
}

const episodes = new Shelf("episode", "episode", (shelf, facts, frames) => {
  const video = byId("episode-video");
  play(video, shelf.file(frames, "mp4"));
  const end = facts.end_reason ? `, ${facts.end_reason.replaceAll("_", " ")}` : "";
  caption(byId("episode-caption"), `Evaluation: return ${short(facts.score)}`,
    `in ${facts.length} steps${end}; after ${short(facts.frames)} frames, ${short(facts.updates)} updates`);
  const strips = [];
  if (facts.attention.length) {
    const about = `now at the top, ${facts.window - 1} steps ahead at the bottom; bright where the policy looks`;
    strips.push(strip("Attention over the rollout window", about, attentionRows(facts.attention), 12 * facts.window, video, facts));
  }
  if (facts.gate.length) {
    const open = facts.gate.reduce((sum, value) => sum + value, 0) / facts.gate.length;
    const about = `bright where the agent is taken to influence the others: ${(100 * open).toFixed(0)}% of the steps`;
    strips.push(strip("Dependency gate", about, [facts.gate], 14, video, facts));
  }
  byId("strips").replaceChildren(...strips);
});

const error = new Chart("Squared pixel error along the sequence", "step");
byId("open-loop-error").append(error.element);

const panels = new Shelf("open_loop", "open-loop", (shelf, facts, frames) => {
  play(byId("open-loop-video"), shelf.file(frames, "mp4"));
  byId("open-loop-still").src = shelf.file(frames, "png");
  caption(byId("open-loop-caption"), "Open-loop prediction",
    `${facts.context} frames seen, then from actions alone; after ${short(facts.frames)} frames, ${short(facts.updates)} updates`);
  const points = facts.error.map((value, step) => [step, value]);
  error.show([
    { name: "seen", color: color("--c2"), points: points.slice(0, facts.context) },
    { name: "predicted", color: color("--c1"), points: points.slice(facts.context) },
  ]);
});

const probes = new Shelf("probe", "probe", (_, facts) => {
  caption(byId("probe-caption"), "Other actions, real and imagined",
    `returns over ${facts.horizon} steps; after ${short(facts.frames)} frames, ${short(facts.updates)} updates`);
  showProbe(facts);
});

/** Shows the media of a run, as `/api/media` lists them. */
export function showMedia(run, media) {
  byId("show").hidden = !media.episode.length && !media.open_loop.length && !media.probe.length;
  episodes.fill(run, media.episode);
  panels.fill(run, media.open_loop);
  probes.fill(run, media.probe);
}

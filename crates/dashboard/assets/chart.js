// Line charts: one SVG each, drawn anew when its data or its width changes.

const SVG = "http://www.w3.org/2000/svg";
const HEIGHT = 190;
const MARGIN = { left: 46, right: 10, top: 8, bottom: 20 };

/** Short words for a number: 12300 -> 12.3k. */
export function short(value) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "-";
  const size = Math.abs(value);
  if (size >= 1e6) return `${+(value / 1e6).toPrecision(3)}M`;
  if (size >= 1e4) return `${+(value / 1e3).toPrecision(3)}k`;
  if (size !== 0 && size < 1e-3) return value.toExponential(1);
  return `${+value.toPrecision(4)}`;
}

/** Every value replaced by the mean of the newest `window` up to it. */
export function smoothed(points, window) {
  let sum = 0;
  return points.map(([x, y], index) => {
    sum += y;
    if (index >= window) sum -= points[index - window][1];
    return [x, sum / Math.min(index + 1, window)];
  });
}

/** Median and range of several lines at common places; a line counts where it has values. */
export function summary(lines) {
  const ends = lines.filter((line) => line.length).map((line) => [line[0][0], line.at(-1)[0]]);
  if (!ends.length) return { points: [], band: [] };
  const from = Math.min(...ends.map(([first]) => first));
  const to = Math.max(...ends.map(([, last]) => last));
  const points = [];
  const band = [];
  for (let step = 0; step <= 120; step += 1) {
    const x = from + ((to - from) * step) / 120;
    const values = lines.map((line) => at(line, x)).filter((y) => y !== null).sort((a, b) => a - b);
    if (!values.length) continue;
    const middle = (values.length - 1) / 2;
    points.push([x, (values[Math.floor(middle)] + values[Math.ceil(middle)]) / 2]);
    band.push([x, values[0], values.at(-1)]);
    if (to === from) break;
  }
  return { points, band };
}

/** The value of a line at `x`, by interpolation; null outside. */
export function at(line, x) {
  if (!line.length || x < line[0][0] || x > line.at(-1)[0]) return null;
  let low = 0;
  let high = line.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (line[middle][0] <= x) low = middle;
    else high = middle;
  }
  const [[x0, y0], [x1, y1]] = [line[low], line[high]];
  return x1 === x0 ? y1 : y0 + ((y1 - y0) * (x - x0)) / (x1 - x0);
}

/** Round numbers between `low` and `high`, each with words that tell it from its neighbours. */
export function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= rough);
  const found = [];
  for (let tick = Math.ceil(low / step) * step; tick <= high + step * 1e-9; tick += step) {
    found.push(Math.abs(tick) < step * 1e-9 ? 0 : tick);
  }
  const size = Math.max(Math.abs(low), Math.abs(high));
  const [scale, suffix] = size >= 1e6 ? [1e6, "M"] : size >= 1e4 ? [1e3, "k"] : [1, ""];
  const digits = Math.max(0, -Math.floor(Math.log10(step / scale) + 1e-9));
  const words = (tick) => {
    if (tick === 0) return "0";
    return size < 1e-3 ? tick.toExponential(1) : `${(tick / scale).toFixed(digits)}${suffix}`;
  };
  return found.map((tick) => [tick, words(tick)]);
}

export function node(name, attributes, parent, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  parent?.append(made);
  return made;
}

/** A chart with a title. `lines` are `{ name, color, points, band }`; `unit` names what lies on the x axis. */
export class Chart {
  constructor(title, unit = "frames") {
    this.unit = unit;
    this.lines = [];
    this.element = document.createElement("article");
    this.element.className = "card chart";
    this.element.innerHTML = "<h3></h3><svg role='img'></svg><p class='values'></p>";
    [this.heading, this.svg, this.values] = this.element.children;
    this.heading.textContent = title;
    this.svg.setAttribute("aria-label", title);
    this.svg.addEventListener("pointermove", (event) => this.point(event.offsetX));
    this.svg.addEventListener("pointerleave", () => this.point(null));
    new ResizeObserver(() => this.draw()).observe(this.element);
  }

  show(lines) {
    this.lines = lines;
    this.draw();
  }

  draw() {
    const width = this.svg.clientWidth;
    if (!width) return;
    this.svg.replaceChildren();
    const points = this.lines.flatMap((line) => line.points);
    if (!points.length) {
      this.values.textContent = "no values yet";
      return;
    }
    const bands = this.lines.flatMap((line) => line.band ?? []);
    const ys = [...points.map((p) => p[1]), ...bands.flatMap((b) => [b[1], b[2]])];
    const xs = points.map((p) => p[0]);
    const least = (list) => list.reduce((a, b) => Math.min(a, b));
    const most = (list) => list.reduce((a, b) => Math.max(a, b));
    let [low, high] = [least(ys), most(ys)];
    const room = (high - low || Math.abs(high) || 1) * 0.06;
    [low, high] = [low - room, high + room];
    const [first, last] = [Math.min(0, least(xs)), most(xs) || 1];
    this.x = (value) => MARGIN.left + ((value - first) / (last - first)) * (width - MARGIN.left - MARGIN.right);
    this.y = (value) => HEIGHT - MARGIN.bottom - ((value - low) / (high - low)) * (HEIGHT - MARGIN.top - MARGIN.bottom);
    this.frame = (px) => first + ((px - MARGIN.left) / (width - MARGIN.left - MARGIN.right)) * (last - first);
    for (const [tick, words] of ticks(low, high, 4)) {
      node("line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: this.y(tick), y2: this.y(tick) }, this.svg);
      node("text", { x: MARGIN.left - 6, y: this.y(tick) + 4, "text-anchor": "end" }, this.svg, words);
    }
    for (const [tick, words] of ticks(first, last, Math.max(2, Math.floor(width / 110)))) {
      const anchor = this.x(tick) > width - 30 ? "end" : "middle";
      node("text", { x: this.x(tick), y: HEIGHT - 4, "text-anchor": anchor }, this.svg, words);
    }
    for (const line of this.lines) {
      if (line.band?.length > 1) {
        const upper = line.band.map(([x, , top]) => `${this.x(x)},${this.y(top)}`);
        const lower = line.band.map(([x, bottom]) => `${this.x(x)},${this.y(bottom)}`).reverse();
        node("polygon", { class: "band", points: [...upper, ...lower].join(" "), fill: line.color }, this.svg);
      }
      const path = line.points.map(([x, y]) => `${this.x(x)},${this.y(y)}`).join(" ");
      if (line.points.length > 1) node("polyline", { class: "line", points: path, stroke: line.color }, this.svg);
      else node("circle", { cx: path.split(",")[0], cy: path.split(",")[1], r: 3, fill: line.color }, this.svg);
    }
    this.cursor = node("line", { class: "cursor", y1: MARGIN.top, y2: HEIGHT - MARGIN.bottom, visibility: "hidden" }, this.svg);
    this.say(null);
  }

  /** Values under the pointer, or the newest ones. */
  point(px) {
    if (!this.cursor) return;
    this.cursor.setAttribute("visibility", px === null ? "hidden" : "visible");
    if (px !== null) {
      this.cursor.setAttribute("x1", px);
      this.cursor.setAttribute("x2", px);
    }
    this.say(px === null ? null : this.frame(px));
  }

  say(frame) {
    const words = this.lines.map((line) => {
      const value = frame === null ? line.points.at(-1)?.[1] ?? null : at(line.points, frame);
      const said = document.createElement("span");
      said.style.color = line.color;
      said.textContent = `${line.name} ${short(value)}`;
      return said;
    });
    const place = document.createElement("span");
    place.textContent = frame === null ? "newest" : `${this.unit} ${short(frame)}`;
    this.values.replaceChildren(place, ...words);
  }
}

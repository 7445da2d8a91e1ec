// Moving curves: one frame per unit, drawn from the rings at most 20 times a second, and less often if drawing is slow.

import { h, fill, text } from "./dom.js";
import { count, figure, hertz, number } from "./format.js";
import { between, columnsOf, Hour, seed } from "./past.js";
import { restless } from "./ring.js";
import { toShown } from "./shapes.js";
import { changed, now, on, ringOf, scaleOf, state, streamedOf } from "./state.js";

const FRAME = 50; // ms between two drawings
const SHARE = 0.35; // most of the time that drawing may take
const BEHIND = 0.25; // s by which the right edge lags, so that values that come in batches do not jump
const COLOURS = 8;
const DASHES = [[], [7, 3], [2, 3], [10, 3, 2, 3]];
const PAINT = 17; // ms between two frames of an idle browser

const LIVE = 120; // s drawn from data received by this page; older data come from the station's history
const ASK = 3000; // ms between two requests for that history
const POINTS = 900; // bins of a zoomed range

export const WINDOWS = [10, 30, 120, 600, 3600];

/** Colours of the present theme. */
function theme() {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(name).trim();
  return {
    lines: Array.from({ length: COLOURS }, (_, index) => read(`--line-${index + 1}`)),
    grid: read("--grid"),
    text: read("--muted"),
    lost: read("--bad"),
    invalid: read("--warn"),
    font: `12px ${read("--font")}`,
  };
}

/** A channel for a plot; one without calibration by its raw numbers, in a frame of its own. */
export function plotted(uuid, channel, label) {
  const { number, problem } = channel;
  return problem ? { uuid, number, label, unit: "raw, not calibrated", uncertainty: null, turn: null, problem } : { uuid, number, label, unit: channel.unit ?? "", uncertainty: channel.uncertainty, turn: channel.turn, problem };
}

/** A panel of moving curves. `channels`: [{uuid, number, label, unit, uncertainty, problem}]. */
export class LivePlot {
  constructor(channels) {
    this.channels = channels;
    this.window = 30;
    this.paused = null; // the time at the right edge while paused
    this.range = null; // [from, to] of the zoomed range
    this.zoomed = new Map(); // its bins, by channel
    this.hours = new Map(); // Hour by channel
    this.onzoom = () => {};
    this.frames = [];
    this.drawn = 0;
    this.skipped = 0;
    this.next = 0;
    this.began = 0; // start of the last drawing, until the next frame
    this.second = { at: performance.now(), frames: 0, received: state.received };
    this.charts = h("div", { class: "charts" });
    this.foot = h("p", { class: "plot-foot" });
    this.element = h("div", { class: "plot" }, this.charts, this.foot);
    this.scheme = matchMedia("(prefers-color-scheme: dark)");
    this.rebuild = () => this.build();
    this.scheme.addEventListener("change", this.rebuild);
    this.watcher = new ResizeObserver(() => this.resize());
    this.watcher.observe(this.charts);
    this.stop = on("connection", () => this.charts.classList.toggle("stale", state.connection !== "live"));
    this.build();
    this.asking = setInterval(() => this.ask(), ASK);
    this.loop = (time) => {
      if (this.ended) return;
      this.painted(time);
      this.draw(time);
      requestAnimationFrame(this.loop);
    };
    requestAnimationFrame(this.loop);
  }

  /** Show other channels. */
  show(channels) {
    const same = channels.length === this.channels.length && channels.every((one, at) => one.label === this.channels[at].label
      && one.uuid === this.channels[at].uuid && one.number === this.channels[at].number && one.unit === this.channels[at].unit);
    this.channels = channels;
    if (!same) this.build();
  }

  hour(channel) {
    const key = `${channel.uuid}/${channel.number}`;
    let hour = this.hours.get(key);
    if (!hour) {
      this.hours.set(key, (hour = new Hour(channel.uuid, channel.number)));
      hour.refresh();
      const ring = state.rings.get(key);
      if (!ring || ring.total < 200) seed(channel.uuid, channel.number).catch(() => {});
    }
    return hour;
  }

  /** Fetch new history for every shown channel. */
  ask() {
    if (document.hidden || state.connection !== "live") return;
    this.channels.forEach((channel) => this.hour(channel).refresh());
  }

  /** Zoom into a range of time; null returns to the moving view. */
  async zoom(range) {
    this.range = range;
    this.zoomed.clear();
    this.onzoom();
    if (!range) return;
    await Promise.all(this.channels.map(async (channel) => {
      const bins = await between(channel.uuid, channel.number, range[0], range[1], POINTS).catch(() => null);
      if (bins && this.range === range) this.zoomed.set(`${channel.uuid}/${channel.number}`, bins);
    }));
  }

  key(event) {
    const [from, to] = this.range ?? [now() - this.window, now()];
    const span = to - from;
    const moves = { "+": [span / 4, -span / 4], "-": [-span / 2, span / 2], ArrowLeft: [-span / 4, -span / 4], ArrowRight: [span / 4, span / 4] };
    if (event.key === "Escape") this.zoom(null);
    else if (moves[event.key]) {
      const [left, right] = moves[event.key];
      const end = Math.min(now(), to + right);
      this.zoom([Math.max(now() - 3600, Math.min(from + left, end - 0.1)), end]);
    } else return;
    event.preventDefault();
  }

  build() {
    this.frames.forEach((frame) => frame.chart.destroy());
    const units = [...new Set(this.channels.map((channel) => channel.unit))];
    const colours = theme();
    this.frames = units.map((unit) => this.frame(unit, this.channels.filter((one) => one.unit === unit), colours));
    fill(this.charts, this.frames.map((frame) => frame.element));
    this.resize();
  }

  frame(unit, channels, colours) {
    const title = unit || "no unit";
    const legend = h("ul", { class: "legend" });
    const values = channels.map((channel, index) => {
      const value = h("span", { class: "figure" }, "no value yet");
      const swatch = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      swatch.setAttribute("class", `swatch line-${(index % COLOURS) + 1}`);
      swatch.setAttribute("viewBox", "0 0 24 4");
      swatch.setAttribute("aria-hidden", "true");
      const line = document.createElementNS("http://www.w3.org/2000/svg", "path");
      line.setAttribute("d", "M0 2h24");
      line.setAttribute("stroke-dasharray", dash(index).join(" "));
      swatch.append(line);
      value.rate = h("span", { class: "hint rate" });
      value.faults = h("span", { class: "faults" });
      legend.append(h("li", {}, swatch, h("span", { class: "label" }, channel.label), value, value.rate, value.faults));
      return value;
    });
    const canvas = h("div", { class: "canvas", role: "img", tabindex: "0", onkeydown: (event) => this.key(event), ondblclick: () => this.zoom(null), "aria-label": `Plot of ${channels.map((one) => one.label).join(", ")} in ${title}. Keys: plus and minus zoom, arrows move, Escape goes back to live.` });
    const when = h("span", { class: "hint when" });
    const element = h("figure", {}, h("figcaption", {}, h("span", { class: "unit" }, title), legend, when), canvas);
    const frame = { element, canvas, channels, values, when, shown: 0, marks: [] };
    const setting = options(channels, colours);
    setting.hooks = { draw: [(chart) => marks(chart, frame.marks, colours)], setSelect: [(chart) => this.selected(chart)], setCursor: [() => (frame.shown = 0)] };
    frame.chart = new window.uPlot(setting, [[], ...channels.map(() => [])], canvas);
    return frame;
  }

  /** Zoom into the range that was selected by dragging. */
  selected(chart) {
    const { left, width } = chart.select;
    if (width < 8) return;
    const range = [chart.posToVal(left, "x"), chart.posToVal(left + width, "x")];
    chart.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.zoom(range);
  }

  resize() {
    for (const frame of this.frames) {
      const width = Math.floor(frame.canvas.clientWidth);
      if (width > 0) frame.chart.setSize({ width, height: heightOf(this.frames.length) });
    }
  }

  draw(time) {
    if (document.hidden || time < this.next || !this.frames.length) return;
    const began = performance.now();
    if (this.next && time - this.next > FRAME) this.skipped += Math.floor((time - this.next) / FRAME);
    const right = this.range?.[1] ?? this.paused ?? now() - BEHIND;
    for (const frame of this.frames) this.one(frame, right, time);
    const took = performance.now() - began;
    this.drawn += 1;
    this.second.frames += 1;
    this.next = time + Math.max(FRAME, took / SHARE) - 8;
    this.began = time;
    this.told();
  }

  /** Painting lines comes after drawing and delays the next frame, so it counts too. */
  painted(time) {
    if (this.began) this.next = Math.max(this.next, this.began + (time - this.began - PAINT) / SHARE);
    this.began = 0;
  }

  one(frame, right, time) {
    const left = this.range?.[0] ?? right - this.window;
    const columns = Math.max(50, Math.min(900, Math.floor(frame.chart.bbox.width / devicePixelRatio) || 300));
    const width = (right - left) / columns;
    // The edges of bins are multiples of their width, so that curves glide and do not flicker.
    const from = Math.floor(left / width) * width;
    const times = Array.from({ length: 3 * columns }, (_, index) => from + (index * width) / 3);
    const courses = frame.channels.map((channel) => {
      const last = state.values.get(`${channel.uuid}/${channel.number}`);
      const silence = Math.max(0.5, 3 * (last?.period ?? 0));
      const [end, hour] = [from + columns * width, this.hour(channel)];
      const stretch = this.range ? (this.zoomed.get(`${channel.uuid}/${channel.number}`) ?? hour.bins) : this.window > LIVE ? hour.bins : null;
      const course = stretch ? columnsOf(stretch, from, end, columns, 3 / (hour.bins.rate || 10), hour.unit) : ringOf(channel.uuid, channel.number).bins(from, end, columns, silence);
      const scale = channel.problem ? { factor: 1, offset: 0 } : scaleOf(channel.uuid, channel.number);
      return course.map((value) => (typeof value === "number" ? toShown(scale, value) : value)); // null ends a line
    });
    frame.marks = frame.channels.map((channel) => [this.hour(channel).bins, left, right]);
    courses.forEach((course, index) => (frame.chart.series[index + 1].dash = restless(course) ? [] : dash(index)));
    frame.chart.batch(() => {
      frame.chart.setData([times, ...courses], false);
      frame.chart.setScale("x", { min: left, max: right });
    });
    if (time - frame.shown > 250) {
      frame.shown = time;
      const place = frame.chart.cursor.left >= 0 ? Math.floor((frame.chart.posToVal(frame.chart.cursor.left, "x") - from) / width) : -1;
      text(frame.when, place >= 0 ? `at ${exact(from + place * width, width)}` : "");
      frame.channels.forEach((channel, index) => {
        const last = streamedOf(channel.uuid, channel.number);
        const value = frame.values[index];
        text(value, place >= 0 ? there(courses[index], place, channel) : figure(last, channel));
        const hour = this.hour(channel);
        text(value.rate, hour.bins.rate ? hertz(hour.bins.rate) : "");
        const { lost, invalid } = hour.faults(left, right);
        text(value.faults, [lost ? `${lost} lost` : "", invalid ? `${invalid} invalid` : ""].filter(Boolean).join(", "));
        value.faults.classList.toggle("bad", lost > 0);
      });
    }
  }

  told() {
    const since = performance.now() - this.second.at;
    if (since < 1000) return;
    const rate = (each) => Math.round((each * 1000) / since);
    const parts = [count(this.channels.length, "channel"), `${rate(state.received - this.second.received)} points/s`];
    parts.push(`${rate(this.second.frames)} fps`);
    parts.push(state.dropped ? `${count(state.dropped, "message")} dropped: this page is too slow` : "no data lost between station and browser");
    text(this.foot, parts.join(" · "));
    Object.assign(this.foot.dataset, { received: state.received, dropped: state.dropped, drawn: this.drawn, skipped: this.skipped });
    this.second = { at: performance.now(), frames: 0, received: state.received };
    changed("plot");
  }

  /** Show this many seconds, up to now. */
  span(seconds) {
    this.window = seconds;
    if (this.range) this.zoom(null);
  }

  pause(yes) {
    this.paused = yes ? now() - BEHIND : null;
  }

  end() {
    this.ended = true;
    clearInterval(this.asking);
    this.stop();
    this.watcher.disconnect();
    this.scheme.removeEventListener("change", this.rebuild);
    this.frames.forEach((frame) => frame.chart.destroy());
  }
}

const heightOf = (frames) => [0, 320, 220][frames] ?? 160;
const dash = (index) => DASHES[Math.floor(index / COLOURS) % DASHES.length];

function axis(colours, extra) {
  const line = { stroke: colours.grid, width: 1 };
  return { stroke: colours.text, font: colours.font, grid: line, ticks: { ...line, size: 4 }, ...extra };
}

function options(channels, colours) {
  return {
    width: 300,
    height: 220,
    legend: { show: false },
    cursor: { show: true, x: true, y: false, points: { show: false }, drag: { x: true, y: false, setScale: false }, focus: { prox: -1 } },
    padding: [8, 24, 0, 0],
    scales: { x: { time: true, auto: false }, y: { range: padded } },
    axes: [axis(colours, { space: 90, size: 30, values: (_, ticks) => ticks.map(hours) }), axis(colours, { size: 60, values: (_, ticks) => ticks.map(tick) })],
    series: [
      {},
      ...channels.map((channel, index) => ({
        label: channel.label,
        stroke: colours.lines[index % COLOURS],
        width: 1, // a browser without a GPU paints a wider line up to thirty times as slowly
        dash: dash(index),
        points: { show: false },
      })),
    ],
  };
}

/** Marks along the lower edge for seconds with lost or invalid samples. */
function marks(chart, channels, colours) {
  const { left, top, width, height } = chart.bbox;
  const size = 5 * devicePixelRatio;
  for (const [bins, from, to] of channels) {
    for (let at = bins.time.length - 1; at >= 0 && bins.time[at] >= from - 1; at--) {
      const colour = bins.lost[at] ? colours.lost : bins.invalid[at] ? colours.invalid : null;
      if (!colour || bins.time[at] > to) continue;
      const place = left + ((Math.max(bins.time[at], from) - from) / (to - from)) * width;
      chart.ctx.fillStyle = colour;
      chart.ctx.fillRect(place, top + height - size, Math.max(2 * devicePixelRatio, (bins.bin / (to - from)) * width), size);
    }
  }
}

/** The text for a curve at a column: a value, or least to greatest. */
function there(course, place, channel) {
  const [low, high] = [course[3 * place], course[3 * place + 1]].sort((one, other) => one - other);
  if (typeof low !== "number") return low === null ? "not valid" : "nothing";
  return low === high || typeof high !== "number" ? number(low, channel.uncertainty, channel.turn) : `${number(low, channel.uncertainty)} to ${number(high, channel.uncertainty)}`;
}

/** Clock time with as many digits as the columns are wide. */
function exact(time, width) {
  const digits = width >= 1 ? 0 : width >= 0.1 ? 1 : 3;
  if (!digits) return hours(time);
  const shown = time.toFixed(digits); // 59.98 s is 60.0 s with one digit
  return `${hours(Number(shown))}${shown.slice(-digits - 1)}`;
}

const hours = (time) => (time === null ? "" : new Date(time * 1000).toTimeString().slice(0, 8));
const tick = (value) => (value === null ? "" : String(Number(value.toPrecision(6))).replaceAll("-", "\u2212"));

/** Some room above and below; a constant curve gets a frame too. */
function padded(_, low, high) {
  if (low === null || low === undefined || high === null) return [0, 1];
  const room = high > low ? (high - low) * 0.08 : Math.abs(high) * 0.05 || 1;
  return [low - room, high + room];
}

/** A static curve: `points` [[x, y] …]. Returns an element, which draws itself once it is in the page. */
export function curvePlot(label, xUnit, yUnit, points) {
  const canvas = h("div", { class: "canvas", role: "img", "aria-label": label });
  const sizes = new ResizeObserver(() => {
    const width = Math.floor(canvas.clientWidth);
    if (width < 50) return;
    canvas.replaceChildren();
    const colours = theme();
    const setting = options([{ label }], colours);
    setting.width = width;
    setting.height = 240;
    setting.scales = { x: { time: false }, y: { range: padded } };
    setting.axes[0].values = setting.axes[1].values;
    setting.axes[0].size = 36;
    setting.axes[0].label = xUnit;
    setting.axes[1].label = yUnit;
    setting.axes.forEach((one) => Object.assign(one, { labelFont: colours.font, labelSize: 18 }));
    setting.series[1].points = { show: points.length < 60, size: 5 };
    new window.uPlot(setting, [points.map(([x]) => x), points.map(([, y]) => y)], canvas);
  });
  sizes.observe(canvas);
  return canvas;
}

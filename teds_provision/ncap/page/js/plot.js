// Curves that move: one frame per unit, drawn from the rings, at most 20 times a second and less where drawing is slow.

import { h, fill, text } from "./dom.js";
import { count, figure } from "./format.js";
import { changed, now, on, ringOf, state } from "./state.js";

const FRAME = 50; // ms between two drawings
const SHARE = 0.35; // of the time that drawing may take
const BEHIND = 0.25; // s: the right edge lies so far back, so that what comes in batches does not jump
const COLOURS = 8;
const DASHES = [[], [7, 3], [2, 3], [10, 3, 2, 3]];

export const WINDOWS = [10, 30, 120];

/** Colours of the theme that is on now. */
function theme() {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(name).trim();
  return {
    lines: Array.from({ length: COLOURS }, (_, index) => read(`--line-${index + 1}`)),
    grid: read("--grid"),
    text: read("--muted"),
    font: `12px ${read("--font")}`,
  };
}

/** A panel of moving curves. `channels`: [{uuid, number, label, unit, uncertainty, problem}]. */
export class LivePlot {
  constructor(channels) {
    this.channels = channels;
    this.window = 30;
    this.paused = null; // the time at the right edge while it stands
    this.frames = [];
    this.drawn = 0;
    this.skipped = 0;
    this.next = 0;
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
    this.loop = (time) => {
      if (this.ended) return;
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
      legend.append(h("li", {}, swatch, h("span", { class: "label" }, channel.label), value));
      return value;
    });
    const canvas = h("div", { class: "canvas", role: "img", "aria-label": `Plot of ${channels.map((one) => one.label).join(", ")} in ${title}` });
    const element = h("figure", {}, h("figcaption", {}, h("span", { class: "unit" }, title), legend), canvas);
    const chart = new window.uPlot(options(channels, colours), [[], ...channels.map(() => [])], canvas);
    return { element, canvas, chart, channels, values, shown: 0 };
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
    const right = this.paused ?? now() - BEHIND;
    for (const frame of this.frames) this.one(frame, right, time);
    const took = performance.now() - began;
    this.drawn += 1;
    this.second.frames += 1;
    this.next = time + Math.max(FRAME, took / SHARE) - 8;
    this.told();
  }

  one(frame, right, time) {
    const left = right - this.window;
    const columns = Math.max(50, Math.min(900, Math.floor(frame.chart.bbox.width / devicePixelRatio) || 300));
    const width = this.window / columns;
    // Bins stand still in time: their edges are multiples of their width, so that curves glide and do not shimmer.
    const from = Math.floor(left / width) * width;
    const times = Array.from({ length: 3 * columns }, (_, index) => from + (index * width) / 3);
    const courses = frame.channels.map((channel) => {
      const last = state.values.get(`${channel.uuid}/${channel.number}`);
      const silence = Math.max(0.5, 3 * (last?.period ?? 0));
      return ringOf(channel.uuid, channel.number).bins(from, from + columns * width, columns, silence);
    });
    frame.chart.batch(() => {
      frame.chart.setData([times, ...courses], false);
      frame.chart.setScale("x", { min: left, max: right });
    });
    if (time - frame.shown > 250) {
      frame.shown = time;
      frame.channels.forEach((channel, index) => {
        const last = state.values.get(`${channel.uuid}/${channel.number}`);
        text(frame.values[index], figure(last, channel));
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

  pause(yes) {
    this.paused = yes ? now() - BEHIND : null;
  }

  end() {
    this.ended = true;
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
    cursor: { show: false },
    padding: [8, 24, 0, 0],
    scales: { x: { time: true, auto: false }, y: { range: padded } },
    axes: [axis(colours, { space: 90, size: 30, values: (_, ticks) => ticks.map(hours) }), axis(colours, { size: 60, values: (_, ticks) => ticks.map(tick) })],
    series: [
      {},
      ...channels.map((channel, index) => ({
        label: channel.label,
        stroke: colours.lines[index % COLOURS],
        width: 1.5,
        dash: dash(index),
        points: { show: false },
      })),
    ],
  };
}

const hours = (time) => (time === null ? "" : new Date(time * 1000).toTimeString().slice(0, 8));
const tick = (value) => (value === null ? "" : String(Number(value.toPrecision(6))).replace("-", "\u2212"));

/** A little room above and below; a course that stands still gets a frame too. */
function padded(_, low, high) {
  if (low === null || low === undefined || high === null) return [0, 1];
  const room = high > low ? (high - low) * 0.08 : Math.abs(high) * 0.05 || 1;
  return [low - room, high + room];
}

/** A curve that stands: `points` [[x, y] …]. Returns an element; it draws itself when it is in the page. */
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

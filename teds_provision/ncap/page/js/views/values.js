// The live tab: values with units, actuators, start and stop of measuring, curves.

import { paths, post, Refusal, remove } from "../api.js";
import { button, chip, empty, field, fill, h, icon, keyed, say, text, trouble } from "../dom.js";
import { age, channelName, count, figure as words, hertz, nameOf, range, reading, short, whyNoNumber } from "../format.js";
import { LivePlot, plotted, WINDOWS } from "../plot.js";
import { isOfCommand, isStale, lastOf, measuring, now, on, refresh, state } from "../state.js";
import { ActuatorPanel } from "./actuator.js";
import { RateHint } from "./rates.js";
import { SetPoints } from "./setpoints.js";

const MOVING = 12; // most channels in a node's plot

export class LiveTab {
  constructor(parent, uuid) {
    this.uuid = uuid;
    this.rows = h("tbody", {});
    this.table = h(
      "table",
      { class: "values" },
      h("caption", { class: "unseen" }, "Channels and their latest values"),
      h("thead", {}, h("tr", {}, ["Channel", "Value", "", "Range", "Uncertainty", "Max. rate", "Calibrated"].map((words, at) => (at === 2 ? h("td", {}) : h("th", { scope: "col", class: at === 1 ? "n" : "" }, words))))),
      this.rows,
    );
    this.none = h("div", {});
    this.mode = new ModePanel(uuid);
    this.actuators = h("div", { class: "actuators" });
    this.plotBox = h("section", { class: "panel", "aria-label": "Plot" });
    this.plot = null;
    this.panels = new Map();
    parent.append(this.mode.element, h("section", { class: "panel", "aria-label": "Values" }, h("h3", {}, "Values"), h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Table of values" }, this.table), this.none), this.actuators, this.plotBox);
    this.stop = on("nodes measurements connection", () => this.paint());
    this.ticking = setInterval(() => this.values(), 250);
    this.paint();
  }

  get node() {
    return state.nodes.get(this.uuid) ?? { channels: [] };
  }

  paint() {
    const channels = this.node.channels ?? [];
    this.table.hidden = !channels.length;
    if (channels.length) this.none.replaceChildren();
    else this.nothing(this.node.whitelisted === false);
    keyed(this.rows, channels, (one) => `${one.number}`, row, (element, one) => facts(element, one));
    const movable = channels.filter((channel) => channel.kind === "actuator");
    keyed(this.actuators, movable, (one) => one.number, (one) => this.actuator(one), (_, one) => this.panels.get(one.number).paint());
    this.mode.paint();
    this.course(channels.filter((channel) => channel.kind !== "actuator"));
    this.values();
  }

  /** No channels: offer to provision an unknown node, or to read the datasheet of a known one. */
  nothing(stranger) {
    if (this.none.dataset.stranger === String(stranger) && this.none.firstChild) return;
    this.none.dataset.stranger = String(stranger);
    const [datasheet, provision] = ["datasheet", "provision"].map((tab) => `#/nodes/${this.uuid}/${tab}`);
    const words = stranger
      ? [h("p", {}, "This node is not on the station's whitelist, so the station does not open a session with it."), h("p", {}, h("a", { class: "action", href: provision }, "Provision this node"))]
      : [h("p", {}, "The station has not read this node's datasheet yet, or the node has none."), h("p", {}, h("a", { class: "action", href: datasheet }, "Read or write the datasheet")), h("p", {}, h("a", { href: provision }, "Provision it again"))];
    fill(this.none, empty(stranger ? "Not on the whitelist" : "No channels", words));
  }

  actuator(channel) {
    const panel = new ActuatorPanel(this.uuid, channel.number);
    this.panels.set(channel.number, panel);
    return panel.element;
  }

  course(channels) {
    const running = measuring(this.uuid) !== null || channels.some((channel) => state.rings.has(`${this.uuid}/${channel.number}`));
    this.plotBox.hidden = !channels.length;
    if (!running) {
      this.plot?.end();
      this.plot = null;
      fill(this.plotBox, h("h3", {}, "Plot"), h("p", { class: "hint" }, "Press Measure to see live values."));
      return;
    }
    const shown = channels.slice(0, MOVING).map((channel) => plotted(this.uuid, channel, channelName(channel)));
    if (this.plot) {
      this.plot.show(shown);
      return;
    }
    this.plot = new LivePlot(shown);
    fill(this.plotBox, plotHead(this.plot, "h3"), this.plot.element);
  }

  values() {
    const time = now();
    const report = measuring(this.uuid)?.nodes?.find((one) => one.uuid === this.uuid);
    for (const channel of this.node.channels ?? []) {
      const element = this.rows.keyed?.get(`${channel.number}`);
      if (!element) continue;
      const last = lastOf(this.uuid, channel);
      const stale = isStale(last);
      const { figure, old, bar, unit } = element.parts;
      if (channel.kind === "actuator") {
        const told = channel.actuator;
        const set = told?.safe === false;
        text(figure, set ? reading(told.value, channel) : told?.safe === true ? "safe state" : "not set");
        if (unit) unit.hidden = !set;
        element.classList.toggle("actuator-row", true);
        if (bar) bar.value = told?.safe === false ? told.value : channel.low;
        continue;
      }
      text(figure, words(last, channel));
      figure.title = whyNoNumber(last, channel, report);
      if (unit) unit.hidden = typeof last?.value !== "number";
      text(old, last ? (stale ? age(time - last.time) : "") : "");
      element.classList.toggle("stale", stale);
      element.classList.toggle("fresh", !stale);
      if (bar) bar.value = last?.value ?? channel.low;
      if (bar) bar.hidden = Boolean(channel.problem); // a raw number cannot be placed in the range
    }
  }

  end() {
    this.stop();
    clearInterval(this.ticking);
    this.plot?.end();
    this.panels.forEach((panel) => panel.end());
    this.mode.end();
  }
}

function row() {
  const figure = h("span", { class: "figure" }, "no value yet");
  const old = h("span", { class: "old" });
  const element = h("tr", {});
  element.parts = { figure, old, bar: null, unit: null };
  return element;
}

function facts(element, channel) {
  const told = JSON.stringify([channel.name, channel.unit, channel.low, channel.high, channel.uncertainty, channel.rate, channel.calibrated, channel.due, channel.overdue, channel.kind]);
  if (element.told === told) return;
  element.told = told;
  const { figure, old } = element.parts;
  const bounded = typeof channel.low === "number" && typeof channel.high === "number" && channel.high > channel.low;
  const bar = bounded ? h("meter", { min: channel.low, max: channel.high, "aria-label": `${channelName(channel)} within its range` }) : null;
  element.parts.bar = bar;
  element.parts.unit = channel.unit ? h("span", { class: "unit" }, ` ${channel.unit}`) : null;
  const kind = { actuator: ["plain", "play", "Actuator"], event: ["plain", "clock", "Event"] }[channel.kind];
  fill(
    element,
    h("th", { scope: "row" }, h("span", { class: "number" }, `${channel.number}`), h("span", { class: "name" }, channelName(channel)), kind ? chip(...kind) : null),
    h("td", { class: "n value" }, figure, element.parts.unit),
    h("td", { class: "within" }, bar, old),
    h("td", { "data-label": "Range" }, range(channel)),
    h("td", { "data-label": "Uncertainty" }, typeof channel.uncertainty === "number" ? `± ${short(channel.uncertainty)}${channel.unit ? ` ${channel.unit}` : ""}` : "not stated"),
    h("td", { "data-label": "Max. rate" }, channel.kind === "actuator" ? "by set point" : hertz(channel.rate)),
    h("td", { "data-label": "Calibrated" }, calibrated(channel)),
  );
}

function calibrated(channel) {
  if (!channel.calibrated) return h("span", { class: "hint" }, "no calibration");
  if (channel.overdue) return chip("warn", "warn", `${channel.calibrated}, was due ${channel.due}`);
  return h("span", { class: "dates" }, h("span", {}, channel.calibrated), channel.due ? [" ", h("span", { class: "hint" }, `due ${channel.due}`)] : null);
}

/** Header of a plot: time window and pause. */
export function plotHead(plot, tag, title = "Plot") {
  const windows = h("div", { class: "switch", role: "group", "aria-label": "Time shown" });
  const show = (seconds) => {
    plot.span(seconds);
    for (const choice of windows.children) choice.setAttribute("aria-pressed", String(Number(choice.dataset.seconds) === seconds));
  };
  windows.append(...WINDOWS.map((seconds) => button(seconds < 60 ? `${seconds} s` : seconds < 3600 ? `${seconds / 60} min` : "1 h", { "data-seconds": seconds, onclick: () => show(seconds) })));
  show(plot.window);
  const pause = button("Pause", {
    "aria-pressed": "false",
    onclick: () => {
      const yes = plot.paused === null;
      plot.pause(yes);
      pause.setAttribute("aria-pressed", String(yes));
      text(pause.lastChild, yes ? "Resume" : "Pause");
    },
  });
  const back = button("Back to live", { hidden: true, onclick: () => plot.zoom(null) }, "play");
  plot.onzoom = () => (back.hidden = !plot.range);
  return h("div", { class: "panel-head plot-head" }, h(tag, {}, title), windows, pause, back);
}

/** Shows if the node is measured, and how fast. */
class ModePanel {
  constructor(uuid) {
    this.uuid = uuid;
    this.rate = h("input", { type: "number", min: "0.01", step: "any", inputmode: "decimal", placeholder: "default", class: "narrow" });
    this.idle = button("Idle", { onclick: () => this.idle.busy(() => this.stop()) }, "stop");
    this.run = button("Measure", { onclick: () => this.run.busy(() => this.start()) }, "play");
    this.state = h("p", { class: "state" });
    this.setPoints = new SetPoints();
    this.error = h("div", {});
    const both = h("div", { class: "switch", role: "group", "aria-label": "Mode" }, this.idle, this.run);
    this.element = h("section", { class: "panel mode", "aria-label": "Configure" }, h("div", { class: "row" }, h("h3", {}, "Configure"), both, field("Rate, Hz", this.rate), this.state), this.setPoints.element, this.error);
    this.hint = new RateHint(this.rate, () => new URLSearchParams({ uuids: uuid }), () => this.again());
    this.error.before(this.hint.element);
    this.off = on("status connection measurements", () => this.paint());
  }

  get measurement() {
    return measuring(this.uuid);
  }

  paint() {
    const node = state.nodes.get(this.uuid);
    const sensors = (node?.channels ?? []).filter((channel) => channel.kind !== "actuator").length;
    this.element.hidden = !node || !(node.channels ?? []).length;
    const one = this.measurement;
    const may = state.connection === "live" && state.status?.write !== false;
    this.idle.setAttribute("aria-pressed", String(!one));
    this.run.setAttribute("aria-pressed", String(Boolean(one)));
    const own = one && !one.group;
    this.idle.disabled = !may || !own;
    this.run.disabled = !may || Boolean(one) || !sensors || node?.whitelisted === false;
    this.rate.disabled = Boolean(one);
    const stranger = node?.whitelisted === false;
    this.setPoints.paint([this.uuid], one);
    if (this.element.hidden || !sensors || stranger || (one && !own)) this.hint.hide();
    else this.hint.paint(one, may);
    if (!one && stranger) fill(this.state, "Not on the whitelist: ", h("a", { href: `#/nodes/${this.uuid}/provision` }, "provision it first"), ".");
    else if (!one) fill(this.state, sensors ? "Idle." : "This node has no sensors to measure.");
    else if (isOfCommand(one)) fill(this.state, "Measured as part of group ", h("a", { href: "#/measure" }, one.group), ` by the command measure (process ${one.process?.id}). End it there with Ctrl-C.`);
    else if (one.group) fill(this.state, "Measured as part of group ", h("a", { href: "#/measure" }, one.group), ". Stop it there.", one.state === "failed" ? h("span", { class: "warn" }, ` It has failed: ${one.why}`) : null);
    else fill(this.state, told(one, this.uuid));
  }

  async start() {
    this.error.replaceChildren();
    const rate = this.rate.value.trim() === "" ? null : Number(this.rate.value);
    try {
      requireRate([this.uuid], rate);
      await post("measurements", { uuids: [this.uuid], rate, kind: "periodic", trigger: false, sinks: [], ...this.setPoints.asked });
      say("Measuring.");
      await refresh("measurements", "nodes");
    } catch (error) {
      fill(this.error, trouble(error));
    }
  }

  /** Start again at the rate now in the field; all other settings as before. */
  async again() {
    const { id, uuids, channels, kind, trigger, sinks, actuators, dead_man } = this.measurement;
    try {
      await remove(paths.measurement(id));
      await post("measurements", { uuids, channels, rate: Number(this.rate.value), kind, trigger, sinks: sinks.map((sink) => sink.split("/").at(-1)), actuators, dead_man });
      await refresh("measurements", "nodes");
    } catch (error) {
      fill(this.error, trouble(error));
    }
  }

  async stop() {
    this.error.replaceChildren();
    try {
      await remove(paths.measurement(this.measurement.id));
      say("Idle.");
      await refresh("measurements", "nodes");
    } catch (error) {
      fill(this.error, trouble(error));
    }
  }

  end() {
    this.off();
  }
}

/** Throw if a sensor's datasheet does not permit the rate: the measurement would wait for ever. */
export function requireRate(uuids, rate) {
  if (rate === null) return;
  if (!(rate > 0)) throw new Refusal(0, "usage", "Enter a rate above 0 Hz.", "Or leave it empty to use the rate in the datasheet.");
  for (const uuid of uuids) {
    const node = state.nodes.get(uuid);
    const slow = (node?.channels ?? []).find((channel) => channel.kind === "sensor" && channel.rate && channel.rate < rate * (1 - 1e-6));
    if (slow) throw new Refusal(0, "refused", `${channelName(slow)} of ${nameOf(node)} supports at most ${hertz(slow.rate)}.`, "Enter a lower rate, or leave it empty to use the rate in each datasheet.");
  }
}

/** Invalid values by reason, the most frequent first, without those that `why` already contains. */
function invalid(node, why) {
  const reasons = [...(node.invalid_why ?? [])].sort((one, other) => other.count - one.count);
  const most = reasons.filter((one) => !why.includes(one.why)).slice(0, 3);
  const nameOfChannel = (number) => channelName(state.nodes.get(node.uuid)?.channels?.find((one) => one.number === number) ?? { number });
  const words = most.map((one) => `${nameOfChannel(one.channel)}: ${one.why}`).join("; ") || (reasons.length ? "" : "no reason given");
  return `${node.invalid} invalid${words ? ` (${words})` : ""}`;
}

/** State of a node in a measurement, as text. */
export function told(measurement, uuid) {
  const node = measurement.nodes?.find((one) => one.uuid === uuid);
  const word = node?.state ?? measurement.state ?? "starting";
  const parts = [word];
  if (typeof node?.samples === "number") parts.push(count(node.samples, "sample"), node.lost ? `${node.lost} lost` : "none lost");
  if (node?.late) parts.push(`${node.late} late`);
  if (node?.bad) parts.push(`${node.bad} bad`);
  const why = node?.why ?? measurement.why ?? "";
  if (node?.invalid) parts.push(invalid(node, why));
  return [icon(word === "running" ? "wave" : word === "refused" || word === "lost" ? "warn" : "clock"), ` ${parts.join(", ")}.`, why ? ` ${why}` : ""];
}


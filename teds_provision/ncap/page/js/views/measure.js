// Groups, measurements, and the moving plot.

import { change, paths, post, remove } from "../api.js";
import { button, chip, empty, field, fill, h, icon, keyed, say, text, toast, trouble } from "../dom.js";
import { byName, channelName, count, nameOf, namesOf, verdict } from "../format.js";
import { LivePlot, plotted } from "../plot.js";
import { isOfCommand, measuring, membersOf, on, refresh, state } from "../state.js";
import { RateHint } from "./rates.js";
import { SetPoints } from "./setpoints.js";
import { plotHead, requireRate, told } from "./values.js";

const MOST = 20; // channels in the plot

export function measureView(main) {
  const groups = new Groups();
  const course = new Course();
  main.append(h("h2", { class: "view-title" }, "Measure"), h("div", { class: "columns" }, groups.element, course.element));
  return { end: () => [groups, course].forEach((part) => part.end()) };
}

class Groups {
  constructor() {
    this.list = h("ul", { class: "groups" });
    this.none = h("div", {});
    this.name = h("input", { type: "text", maxlength: "64", autocomplete: "off", required: true });
    this.members = h("fieldset", { class: "members" }, h("legend", {}, "Nodes"), h("div", { class: "ticks" }));
    this.make = button("Create group", { class: "main", onclick: () => this.make.busy(() => this.create()) }, "plus");
    this.error = h("div", {});
    this.fresh = h("details", { class: "panel new" }, h("summary", {}, icon("plus"), "New group"), h("div", { class: "stack" }, field("Name", this.name, "Letters, digits and _; the topic gets this name."), this.members, h("div", { class: "row" }, this.make), this.error));
    this.others = h("ul", { class: "groups" });
    this.all = button("Measure all trusted nodes", { onclick: () => this.all.busy(() => this.everything()) }, "play");
    this.element = h("section", { class: "side-wide", "aria-label": "Groups" }, h("div", { class: "row" }, this.all), h("h3", {}, "Groups"), this.none, this.list, this.fresh, this.others);
    this.off = on("groups measurements nodes status connection", () => this.paint());
    this.paint();
  }

  paint() {
    const may = state.connection === "live" && state.status?.write !== false;
    if (state.groups.length) this.none.replaceChildren();
    else if (!this.none.firstChild) fill(this.none, empty("No groups yet.", h("p", {}, "A group is a set of nodes measured together on one time line. Open New group, enter a name, select its nodes, then press Start.")));
    keyed(this.list, state.groups, (group) => group.name, (group) => new GroupCard(group.name).element, (element, group) => element.card.paint(group, may));
    const lone = state.measurements.filter((one) => !one.group);
    keyed(this.others, lone, (one) => `${one.id}`, (one) => loneCard(one), (element, one) => element.paint(one, may));
    const nodes = [...state.nodes.values()].filter((node) => node.whitelisted !== false).sort(byName);
    keyed(this.members.lastChild, nodes, (node) => node.uuid, tick, (element, node) => {
      text(element.querySelector("span"), nameOf(node));
      text(element.querySelector(".hint"), verdict(node)[2].toLowerCase());
    });
    if (this.make.getAttribute("aria-busy") !== "true") this.make.disabled = !may;
    this.all.hidden = state.measurements.some((one) => one.match === "all");
    if (this.all.getAttribute("aria-busy") !== "true") this.all.disabled = !may;
  }

  /** Measure every authentic node, present ones and later arrivals, until its card here is stopped. */
  async everything() {
    this.error.replaceChildren();
    try {
      await post("measurements", { match: "all" });
      say("Every trusted node is measured now, and as soon as it appears.");
      await refresh("measurements", "nodes");
    } catch (error) {
      toast("bad", error.message, error.hint);
    }
  }

  async create() {
    this.error.replaceChildren();
    const name = this.name.value.trim();
    const uuids = [...this.members.querySelectorAll("input:checked")].map((box) => box.value);
    if (!name || !uuids.length) {
      fill(this.error, trouble({ message: name ? "Select at least one node." : "Enter a name for the group.", hint: name ? "A group is the nodes that you want to measure together." : "A short one will do, such as hand." }));
      return;
    }
    try {
      await post("groups", { name, uuids });
      this.name.value = "";
      this.members.querySelectorAll("input:checked").forEach((box) => (box.checked = false));
      this.fresh.open = false;
      say(`Group ${name} created. Press Start to measure it.`);
      await refresh("groups", "nodes");
    } catch (error) {
      fill(this.error, trouble(error));
    }
  }

  end() {
    this.off();
  }
}

function tick(node, checked = false) {
  const box = h("input", { type: "checkbox", value: node.uuid, checked });
  return h("label", { class: "tick" }, box, h("span", {}, nameOf(node)), h("span", { class: "hint" }));
}

class GroupCard {
  constructor(name) {
    this.name = name;
    this.state = h("span", {});
    this.members = h("ul", { class: "member-list" });
    this.rate = h("input", { type: "number", min: "0.01", step: "any", inputmode: "decimal", placeholder: "default", class: "narrow" });
    this.kind = h("select", {}, h("option", { value: "periodic" }, "periodic"), h("option", { value: "event" }, "event"), h("option", { value: "free" }, "free"));
    this.trigger = h("input", { type: "checkbox" });
    this.setPoints = new SetPoints();
    this.record = h("input", { type: "text", placeholder: "run.csv", autocomplete: "off" });
    this.start = button("Start", { class: "main", onclick: () => this.start.busy(() => this.go()) }, "play");
    this.stop = button("Stop", { onclick: () => this.stop.busy(() => this.halt()) }, "stop");
    this.others = h("fieldset", { class: "members" }, h("legend", {}, "Members"), h("div", { class: "ticks" }));
    this.keep = button("Save members", { onclick: () => this.keep.busy(() => this.remember()) });
    this.drop = button("Delete group", { class: "quiet" });
    this.drop.addEventListener("click", () => this.drop.busy(() => this.away()));
    this.more = h("details", { class: "more" }, h("summary", {}, "More"), h("div", { class: "row" }, field("Kind", this.kind), h("label", { class: "tick" }, this.trigger, h("span", {}, "Start all nodes together (trigger)")), field("Record to", this.record, "A file name in the station's recording folder, ending in .csv, .txt, .mcap or .jsonl.")), this.setPoints.element, this.others, h("div", { class: "row" }, this.keep, this.drop));
    this.error = h("div", {});
    this.whose = h("p", { class: "hint" });
    this.element = h("li", { class: "panel group" }, h("div", { class: "panel-head" }, h("h4", {}, name), this.state), this.whose, this.members, h("div", { class: "row" }, field("Rate, Hz", this.rate), this.start, this.stop), this.more, this.error);
    this.element.card = this;
    this.hint = new RateHint(this.rate, () => new URLSearchParams({ group: name }), () => this.again());
    this.more.before(this.hint.element);
    this.start.setAttribute("aria-label", `Start ${name}`);
    this.stop.setAttribute("aria-label", `Stop ${name}`);
  }

  get measurement() {
    return state.measurements.find((one) => one.group === this.name) ?? null;
  }

  paint(group, may) {
    const one = this.measurement;
    const words = one ? (one.state ?? "running") : "idle";
    const tone = !one ? ["plain", "stop"] : { running: ["busy", "wave"], failed: ["bad", "warn"], refused: ["bad", "warn"], lost: ["warn", "warn"] }[words] ?? ["plain", "clock"];
    if (this.state.textContent !== words) fill(this.state, chip(...tone, words));
    const members = (group.uuids ?? []).map((uuid) => state.nodes.get(uuid) ?? { uuid }).sort(byName);
    keyed(this.members, members.map((node) => node.uuid), (uuid) => uuid, (uuid) => h("li", {}, h("a", { href: `#/nodes/${uuid}` }), h("span", { class: "hint" })), (element, uuid) => {
      text(element.firstChild, nameOf(state.nodes.get(uuid) ?? { uuid }));
      const line = one ? told(one, uuid) : [state.nodes.get(uuid)?.present === false ? "away" : ""];
      const now = line.map((part) => (typeof part === "string" ? part : "")).join("");
      if (element.lastChild.textContent !== now) fill(element.lastChild, line);
    });
    this.start.hidden = Boolean(one);
    this.stop.hidden = !one;
    if (this.start.getAttribute("aria-busy") !== "true") this.start.disabled = !may || !(group.uuids ?? []).length;
    if (this.stop.getAttribute("aria-busy") !== "true") this.stop.disabled = !may || (one !== null && isOfCommand(one));
    text(this.whose, one && isOfCommand(one) ? `Run by the command measure (process ${one.process?.id}). End it there with Ctrl-C.` : "");
    this.paintMembers(group, !may || Boolean(one));
    this.drop.disabled = !may || Boolean(one);
    this.rate.disabled = this.kind.disabled = this.trigger.disabled = this.record.disabled = Boolean(one);
    this.setPoints.paint(group.uuids ?? [], one);
    this.hint.paint(one, may && (group.uuids ?? []).length > 0);
    if (one?.error && this.errorShown !== one.error.message) fill(this.error, trouble(one.error));
    this.errorShown = one?.error?.message;
  }

  /** Check boxes for nodes, with the group's checked. The user's choice is kept when nodes come, until the group
   * changes. */
  paintMembers(group, frozen) {
    const nodes = [...state.nodes.values()].filter((node) => node.whitelisted !== false).sort(byName);
    const told = JSON.stringify([group.uuids, frozen]);
    const anew = this.toldMembers !== told;
    this.toldMembers = told;
    const member = (node) => group.uuids.includes(node.uuid);
    keyed(this.others.lastChild, nodes, (node) => node.uuid, (node) => tick(node, member(node)), (row, node) => {
      text(row.querySelector("span"), nameOf(node));
      row.firstChild.disabled = frozen;
      if (anew) row.firstChild.checked = member(node);
    });
    this.keep.disabled = frozen;
  }

  async remember() {
    const uuids = [...this.others.querySelectorAll("input:checked")].map((box) => box.value);
    await this.does(() => change(paths.group(this.name), { uuids }), `Group ${this.name} has ${count(uuids.length, "member")}.`);
  }

  async go() {
    const rate = this.rate.value.trim() === "" ? null : Number(this.rate.value);
    const record = this.record.value.trim();
    await this.does(() => {
      requireRate(membersOf({ group: this.name }), rate);
      return post("measurements", { group: this.name, rate, kind: this.kind.value, trigger: this.trigger.checked, sinks: record ? [record] : [], ...this.setPoints.asked });
    }, `Group ${this.name} is now measuring.`);
  }

  /** Start again at the rate now in the field; all other settings as before. */
  async again() {
    const { id, kind, trigger, sinks, actuators, dead_man } = this.measurement;
    const names = sinks.map((sink) => sink.split("/").at(-1)); // show a file's name without its folder
    await this.does(async () => {
      await remove(paths.measurement(id));
      return post("measurements", { group: this.name, rate: Number(this.rate.value), kind, trigger, sinks: names, actuators, dead_man });
    }, `Group ${this.name} is now measured at ${this.rate.value} Hz.`);
  }

  async halt() {
    await this.does(() => remove(paths.measurement(this.measurement.id)), `Group ${this.name} is idle.`);
  }

  async away() {
    await this.does(() => remove(paths.group(this.name)), `Group ${this.name} deleted. Its nodes are unchanged.`);
    toast("good", `Group ${this.name} deleted.`);
  }

  async does(work, words) {
    this.error.replaceChildren();
    try {
      await work();
      say(words);
      await refresh("measurements", "groups", "nodes");
    } catch (error) {
      fill(this.error, trouble(error));
    }
  }
}

/** Summary of a measurement's nodes: "15 running, 2 lost, 4200 samples, none lost". */
function inAll(measurement) {
  const states = new Map();
  for (const node of measurement.nodes ?? []) states.set(node.state, (states.get(node.state) ?? 0) + 1);
  const sum = (what) => (measurement.nodes ?? []).reduce((all, node) => all + (node[what] ?? 0), 0);
  const lost = sum("lost");
  return [...[...states].map(([word, many]) => `${many} ${word}`), count(sum("samples"), "sample"), lost ? `${lost} lost` : "none lost"].join(", ");
}

function loneCard(one) {
  const name = h("h4", {});
  const words = h("p", { class: "hint" });
  const stop = button("Stop", {}, "stop");
  const element = h("li", { class: "panel group" }, h("div", { class: "panel-head" }, name, stop), words);
  stop.addEventListener("click", () =>
    stop.busy(async () => {
      try {
        await remove(paths.measurement(one.id));
        await refresh("measurements", "nodes");
      } catch (error) {
        toast("bad", error.message, error.hint);
      }
    }),
  );
  element.paint = (now, may) => {
    const members = membersOf(now).map((uuid) => state.nodes.get(uuid) ?? { uuid }).sort(byName);
    const names = namesOf(members);
    if (now.match) {
      const waiting = now.nodes.filter((node) => node.state === "waiting" && node.why);
      text(name, now.match === "all" ? "All trusted nodes" : now.match);
      text(words, [`${count(members.length, "node")} measured${names ? `: ${names}` : ""}`, ...waiting.map((node) => `${nameOf(state.nodes.get(node.uuid) ?? node)} waits: ${node.why}`)].join(". "));
    } else if (members.length > 1) {
      text(name, count(members.length, "node"));
      text(words, `${inAll(now)}: ${names}.`);
    } else {
      text(name, names);
      fill(words, told(now, members[0]?.uuid));
    }
    if (stop.getAttribute("aria-busy") !== "true") stop.disabled = !may;
  };
  return element;
}

/** The moving plot with a choice of channels. */
class Course {
  constructor() {
    // "uuid/number" → the user's choice, true or false; other channels are shown if they are measured
    this.chosen = new Map();
    this.ticks = h("div", { class: "ticks" });
    this.pick = h("details", { class: "pick" }, h("summary", {}, "Channels"), this.ticks);
    this.plot = new LivePlot([]);
    this.none = h("div", {});
    this.head = plotHead(this.plot, "h3", "Live plot");
    this.element = h("section", { class: "panel wide", "aria-label": "Live plot" }, this.head, this.pick, this.none, this.plot.element);
    this.off = on("nodes measurements groups", () => this.paint());
    this.paint();
  }

  all() {
    return [...state.nodes.values()].sort(byName).flatMap((node) => (node.channels ?? []).filter((channel) => channel.kind !== "actuator").map((channel) => ({ node, channel, key: `${node.uuid}/${channel.number}` })));
  }

  paint() {
    const all = this.all();
    const moving = (one) => this.chosen.get(one.key) ?? measuring(one.node.uuid) !== null;
    const shown = all.filter(moving).slice(0, MOST);
    const names = new Set(shown.map((one) => one.node.uuid)).size > 1;
    this.plot.show(shown.map(({ node, channel }) => plotted(node.uuid, channel, names ? `${nameOf(node)} ${channelName(channel)}` : channelName(channel))));
    keyed(this.ticks, all, (one) => one.key, (one) => this.tick(one), (element, one) => {
      element.firstChild.checked = shown.some((each) => each.key === one.key);
      text(element.lastChild, `${nameOf(one.node)}: ${channelName(one.channel)}`);
    });
    const extra = all.filter(moving).length - MOST;
    text(this.pick.firstChild, `Channels: ${shown.length} of ${all.length} shown${extra > 0 ? ` (at most ${MOST})` : ""}`);
    this.pick.hidden = !all.length;
    this.plot.element.hidden = !shown.length;
    this.head.hidden = !shown.length;
    if (shown.length) this.none.replaceChildren();
    else if (!this.none.firstChild) fill(this.none, empty("No measurement is running.", h("p", {}, "Start a group, or open a node and press Measure, to see live values.")));
  }

  tick(one) {
    const box = h("input", { type: "checkbox", onchange: () => {
      this.chosen.set(one.key, box.checked);
      this.paint();
    } });
    return h("label", { class: "tick" }, box, h("span", {}));
  }

  end() {
    this.off();
    this.plot.end();
  }
}


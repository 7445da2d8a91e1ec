// The station itself: links, sinks, clock, budget, published names.

import { change, get } from "../api.js";
import { button, chip, empty, fill, h, icon, keyed, say, text, toast } from "../dom.js";
import { byName, channelName, clock, count, grouped, heldBy, nameOf, short } from "../format.js";
import { on, refresh, state } from "../state.js";
import { linkName } from "./facts.js";
import { linePanel } from "./line.js";
import { isLinkless, noLink } from "./links.js";

const NAMES = 40; // rows of published names; a button shows as many more

export function stationView(main) {
  const links = h("ul", { class: "lines" });
  const linkless = noLink();
  const sinks = h("ul", { class: "lines" });
  const noSink = h("div", {});
  const foxglove = h("p", { class: "hint", hidden: true });
  const plantFacts = h("dl", { class: "facts-list" });
  const plant = h("ul", { class: "lines" });
  const holders = h("ul", { class: "lines", "aria-label": "Who holds a node" });
  const whose = h("input", { type: "search", placeholder: "UUID or name", "aria-label": "Who holds a node", oninput: () => (clearTimeout(whose.soon), (whose.soon = setTimeout(askHolders, 300))) });
  const plantPanel = h("section", { class: "panel", "aria-label": "Plant", hidden: true }, h("h3", {}, "Plant"), plantFacts, plant, h("div", { class: "panel-head" }, h("h4", {}, "Who holds a node"), whose), holders);
  const line = linePanel();
  const facts = h("dl", { class: "facts-list" });
  const names = h("tbody", {});
  const find = h("input", { type: "search", placeholder: "Node, channel or topic", "aria-label": "Search published names", oninput: () => ((most = NAMES), paint()) });
  const further = button("", { class: "quiet", hidden: true, onclick: () => ((most += NAMES), paint()) });
  let most = NAMES;
  const noName = h("div", {});
  const table = h("table", { class: "names" }, h("caption", { class: "unseen" }, "Published names"), h("thead", {}, h("tr", {}, ["Channel", "Topic"].map((words) => h("th", { scope: "col" }, words)))), names);
  main.append(
    h("h2", { class: "view-title" }, "Station"),
    h(
      "div",
      { class: "grid" },
      h("section", { class: "panel", "aria-label": "Links" }, h("h3", {}, "Links"), linkless, links),
      h("section", { class: "panel", "aria-label": "About" }, h("h3", {}, "About"), facts),
      plantPanel,
      line.panel,
      h("section", { class: "panel", "aria-label": "Where values go" }, h("h3", {}, "Where values go"), foxglove, noSink, sinks),
      h("section", { class: "panel", "aria-label": "Published names" }, h("div", { class: "panel-head" }, h("h3", {}, "Published names"), find), noName, h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Published names" }, table), further),
    ),
  );

  function paint() {
    const status = state.status ?? {};
    keyed(links, status.links ?? [], (one) => one.name, () => h("li", {}), (element, one) => {
      const up = one.state === "up" || one.state === "running";
      again(element, [one.state, one.why], () => [icon(one.kind ?? "can"), h("span", { class: "grow" }, h("strong", {}, linkName(one.kind)), " ", one.name), chip(up ? "good" : "warn", up ? "good" : "warn", one.state), one.why ? h("p", { class: "hint full" }, one.why, one.hint ? ` ${one.hint}` : "") : null]);
    });
    linkless.hidden = !isLinkless();
    foxglove.hidden = !status.foxglove;
    fill(foxglove, "Live for Foxglove on ", h("code", {}, status.foxglove ?? ""));
    keyed(sinks, status.sinks ?? [], (one) => `${one.measurement}/${one.name}`, () => h("li", {}), (element, one) => {
      const bad = one.state === "failed";
      again(element, one, () => [h("span", { class: "grow" }, h("strong", {}, one.name), h("span", { class: "hint" }, ` ${count(one.written ?? 0, "value")} written, ${one.dropped ?? 0} dropped`)), chip(bad ? "bad" : one.dropped ? "warn" : "good", bad || one.dropped ? "warn" : "good", one.state), one.error || ((one.recorder || one.state === "waiting") && one.detail) ? h("p", { class: "hint full" }, one.error || one.detail, one.hint ? ` ${one.hint}` : "") : null]);
    });
    if ((status.sinks ?? []).length || status.foxglove) noSink.replaceChildren();
    else if (!noSink.firstChild) fill(noSink, empty("Values are not recorded or published.", h("p", {}, "Start ncap run with --record, --ros1, --ros2, --mqtt or --foxglove, or enter a file name when you start a group.")));
    about(status);
    paintPlant();
    if (state.names.length) noName.replaceChildren();
    else if (!noName.firstChild) fill(noName, empty("No channels are published yet.", h("p", {}, "Names appear once a node has a datasheet.")));
    const words = find.value.trim().toLowerCase();
    const every = [...state.names].sort((one, other) => byName(nodeOf(one), nodeOf(other)) || one.channel - other.channel);
    const meant = words ? every.filter((one) => `${one.topic ?? ""} ${labelOf(one)}`.toLowerCase().includes(words)) : every;
    find.hidden = state.names.length <= NAMES && !words;
    further.hidden = meant.length <= most;
    text(further.lastChild, `Show ${Math.min(NAMES, meant.length - most)} more of ${meant.length}`);
    table.hidden = !state.names.length;
    keyed(names, meant.slice(0, most), (one) => `${one.uuid}/${one.channel}`, nameRow, (element, one) => element.paint(one));
  }

  function about(status) {
    const budget = status.budget;
    const rows = [
      ["Name", status.station?.name],
      ["Fingerprint", status.station?.fingerprint ? h("code", { class: "print" }, grouped(status.station.fingerprint)) : null],
      ["Version", status.version],
      ["Running since", status.started ? clock(status.started) : null],
      ["Clock error", typeof status.clock_error === "number" ? `± ${short(status.clock_error * 1e6)} µs at most` : "no measurement is running"],
      ["Messages", budget ? `${short(budget.used ?? 0)} of ${short(budget.limit ?? 0)} per second` : null],
      ["This browser", status.write === false ? "read-only" : "read and write"],
    ].filter(([, value]) => value !== null && value !== undefined);
    again(facts, rows.map(([name, value]) => [name, value?.textContent ?? value]), () => rows.map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
  }

  function paintPlant() {
    plantPanel.hidden = !known;
    if (!known) return;
    const rows = [
      ["Plant", `${known.name}, roster ${known.roster} until ${new Date(known.expires * 1000).toISOString().slice(0, 10)}`],
      ["Last sync", known.age === null ? "never" : `${ago(known.age)} ago${known.why ? `: ${known.why}` : ""}`],
      ["Unsent", count(known.unsent, "event")],
      ["To rotate", known.to_rotate ? count(known.to_rotate, "node") : null],
    ].filter(([, value]) => value !== null);
    again(plantFacts, rows, () => rows.map(([name, value]) => [h("dt", {}, name), h("dd", {}, value)]));
    const lines = [
      ...known.alarms.filter((one) => !one.seen).map((one) => ({ key: `alarm ${one.code} ${one.about} ${one.at}`, tone: "bad", word: one.code, name: one.about, told: one.why })),
      ...known.stations.map((one) => ({ key: one.fingerprint, tone: TONES[one.state] ?? "warn", word: one.state, name: one.name, told: `${one.roles.join(" ")}, page ${one.page}${one.age === null ? "" : `, ${ago(one.age)} ago`}` })),
      ...known.conflicts.map((one) => ({ key: `conflict ${one.uuid} ${one.conflict}`, tone: "warn", word: one.conflict, name: nameOf(state.nodes.get(one.uuid) ?? { uuid: one.uuid }), told: one.detail })),
    ];
    keyed(plant, lines, (one) => one.key, () => h("li", {}), (element, one) => again(element, one, () => [h("span", { class: "grow" }, h("strong", {}, one.name), h("span", { class: "hint" }, ` ${one.told}`)), chip(one.tone, one.tone === "good" ? "good" : "warn", one.word)]));
  }

  let known = null;
  async function askPlant() {
    try {
      known = state.status?.plant ? await get("plant") : null;
    } catch {
      known = null; // the station has left the plant meanwhile
    }
    paintPlant();
  }
  async function askHolders() {
    const words = whose.value.trim();
    let found = { nodes: [], more: false };
    try {
      if (words) found = await get(`plant/nodes?text=${encodeURIComponent(words)}`);
    } catch (error) {
      fill(holders, h("li", { class: "hint" }, error.message));
      return;
    }
    if (words !== whose.value.trim()) return; // a later request is in progress
    const lines = found.nodes.map((one) => h("li", {}, h("span", { class: "grow" }, h("strong", {}, one.name || short8(one.uuid)), h("span", { class: "hint" }, ` ${one.uuid}: ${heldBy(one.says)}`)), one.says.revoked.length ? chip("bad", "warn", "revoked") : one.conflicts.length ? chip("warn", "warn", one.conflicts[0].name) : null));
    fill(holders, words && !lines.length ? h("li", { class: "hint" }, "No station reports such a node.") : lines, found.more ? h("li", { class: "hint" }, "More nodes match: enter more of the UUID or name.") : null);
  }

  const asking = setInterval(askPlant, PLANT_EVERY);
  askPlant();

  const off = on("status names nodes", paint);
  refresh("names", "status");
  paint();
  return {
    end() {
      clearInterval(asking);
      line.end();
      off();
    },
  };
}

const PLANT_EVERY = 10000; // ms
const TONES = { here: "good", heard: "good", retired: "plain", lost: "plain", stolen: "plain" };

const short8 = (uuid) => `node ${uuid.slice(0, 8)}`;

function ago(seconds) {
  for (const [unit, length] of [["days", 86400], ["h", 3600], ["min", 60]]) if (seconds >= 2 * length) return `${Math.floor(seconds / length)} ${unit}`;
  return `${Math.floor(seconds)} s`;
}

function again(element, facts, make) {
  const told = JSON.stringify(facts);
  if (element.told === told) return;
  element.told = told;
  fill(element, make());
}

const nodeOf = (one) => state.nodes.get(one.uuid) ?? { uuid: one.uuid };

/** The node or channel of a published name. */
function labelOf(one) {
  const node = nodeOf(one);
  const channel = node.channels?.find((each) => each.number === one.channel);
  return one.channel ? `${nameOf(node)}: ${channel ? channelName(channel) : `channel ${one.channel}`}` : `${nameOf(node)} (the node)`;
}

function nameRow(one) {
  const entry = h("input", { type: "text", class: "topic", spellcheck: "false", autocomplete: "off" });
  const keep = button("Rename", { onclick: () => keep.busy(rename) });
  const label = h("th", { scope: "row" });
  const element = h("tr", {}, label, h("td", {}, h("div", { class: "row tight" }, entry, keep)));
  let known = one;
  async function rename() {
    try {
      await change("names", { uuid: known.uuid, channel: known.channel, name: entry.value.trim().replace(/^\/+/, "") || null });
      entry.told = entry.value;
      say("Renamed.");
      await refresh("names", "nodes");
    } catch (error) {
      toast("bad", error.message, error.hint);
    }
  }
  element.paint = (now) => {
    known = now;
    text(label, labelOf(now));
    entry.setAttribute("aria-label", `Topic of ${label.textContent}`);
    // Keep the text that the user is typing until it is sent, even if the name changes meanwhile.
    if (document.activeElement !== entry && entry.value === (entry.told ?? "")) entry.value = entry.told = now.topic ?? "";
    keep.disabled = state.status?.write === false || state.connection !== "live";
  };
  return element;
}


// The station itself: links, where values go, clock, budget, published names.

import { change } from "../api.js";
import { button, chip, empty, fill, h, icon, keyed, say, text, toast } from "../dom.js";
import { channelName, clock, count, grouped, nameOf, short } from "../format.js";
import { on, refresh, state } from "../state.js";
import { linkName } from "./facts.js";

export function stationView(main) {
  const links = h("ul", { class: "lines" });
  const sinks = h("ul", { class: "lines" });
  const noSink = h("div", {});
  const facts = h("dl", { class: "facts-list" });
  const names = h("tbody", {});
  const noName = h("div", {});
  const table = h("table", { class: "names" }, h("caption", { class: "unseen" }, "Published names"), h("thead", {}, h("tr", {}, ["Channel", "Topic"].map((words) => h("th", { scope: "col" }, words)))), names);
  main.append(
    h("h2", { class: "view-title" }, "Station"),
    h(
      "div",
      { class: "grid" },
      h("section", { class: "panel", "aria-label": "Links" }, h("h3", {}, "Links"), links),
      h("section", { class: "panel", "aria-label": "About" }, h("h3", {}, "About"), facts),
      h("section", { class: "panel", "aria-label": "Where values go" }, h("h3", {}, "Where values go"), noSink, sinks),
      h("section", { class: "panel", "aria-label": "Published names" }, h("h3", {}, "Published names"), noName, h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Published names" }, table)),
    ),
  );

  function paint() {
    const status = state.status ?? {};
    keyed(links, status.links ?? [], (one) => one.name, () => h("li", {}), (element, one) => {
      const up = one.state === "up" || one.state === "running";
      again(element, [one.state, one.why], () => [icon(one.kind ?? "can"), h("span", { class: "grow" }, h("strong", {}, linkName(one.kind)), " ", one.name), chip(up ? "good" : "warn", up ? "good" : "warn", one.state), one.why ? h("p", { class: "hint full" }, one.why, one.hint ? ` ${one.hint}` : "") : null]);
    });
    if (!(status.links ?? []).length && !links.firstChild) fill(links, h("li", { class: "hint" }, "No links. Start ncap run with --can, --nfc or --ble."));
    keyed(sinks, status.sinks ?? [], (one) => one.name, () => h("li", {}), (element, one) => {
      const bad = one.state === "failed";
      again(element, one, () => [h("span", { class: "grow" }, h("strong", {}, one.name), h("span", { class: "hint" }, ` ${count(one.written ?? 0, "value")} written, ${one.dropped ?? 0} dropped`)), chip(bad ? "bad" : one.dropped ? "warn" : "good", bad || one.dropped ? "warn" : "good", one.state), one.error || ((one.recorder || one.state === "waiting") && one.detail) ? h("p", { class: "hint full" }, one.error || one.detail, one.hint ? ` ${one.hint}` : "") : null]);
    });
    if ((status.sinks ?? []).length) noSink.replaceChildren();
    else if (!noSink.firstChild) fill(noSink, empty("Values are not recorded or published.", h("p", {}, "Start ncap run with --record, --ros1, --ros2 or --mqtt, or enter a file name when you start a group.")));
    about(status);
    if (state.names.length) noName.replaceChildren();
    else if (!noName.firstChild) fill(noName, empty("No channels are published yet.", h("p", {}, "Names appear once a node has a datasheet.")));
    table.hidden = !state.names.length;
    keyed(names, state.names, (one) => `${one.uuid}/${one.channel}`, nameRow, (element, one) => element.paint(one));
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

  const off = on("status names nodes", paint);
  refresh("names", "status");
  paint();
  return { end: off };
}

function again(element, facts, make) {
  const told = JSON.stringify(facts);
  if (element.told === told) return;
  element.told = told;
  fill(element, make());
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
      say("Renamed.");
      await refresh("names", "nodes");
    } catch (error) {
      toast("bad", error.message, error.hint);
    }
  }
  element.paint = (now) => {
    const before = known;
    known = now;
    const node = state.nodes.get(now.uuid) ?? { uuid: now.uuid };
    const channel = node.channels?.find((each) => each.number === now.channel);
    text(label, now.channel ? `${nameOf(node)}: ${channel ? channelName(channel) : `channel ${now.channel}`}` : `${nameOf(node)} (the node)`);
    entry.setAttribute("aria-label", `Topic of ${label.textContent}`);
    if (document.activeElement !== entry && (before !== now || !entry.value)) entry.value = now.topic ?? "";
    keep.disabled = state.status?.write === false || state.connection !== "live";
  };
  return element;
}


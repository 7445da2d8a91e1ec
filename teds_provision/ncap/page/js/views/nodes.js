// The list of nodes, and the open one.

import { button, chip, empty, fill, h, icon, keyed, text } from "../dom.js";
import { byName, channelName, count, figure, nameOf, verdict } from "../format.js";
import { isStale, lastOf, now, on, state } from "../state.js";
import { Bulk } from "./bulk.js";
import { facts } from "./facts.js";
import { Filters } from "./filters.js";
import { isLinkless, noLink } from "./links.js";
import { NodePanel } from "./node.js";
import { ProvisionTab } from "./provision.js";
import { latest, progressOf, UpdatePanel } from "./update.js";

const MARKED = 8000; // ms for which a tapped node is marked
const SHOWN_VALUES = 3;
const SEARCH_FROM = 7; // nodes
const NEWS = 3600; // s for which a finished update is linked from the list
const DRAWN = 100; // cards drawn at once; a button draws as many more
const order = (one, other) => Number(other.present ?? false) - Number(one.present ?? false) || byName(one, other);

export function nodesView(main, rest) {
  const filters = new Filters(() => ((drawn = DRAWN), paint()));
  const bulk = new Bulk(() => listed, () => paint());
  const total = h("p", { class: "total" });
  const updating = h("a", { href: "#/nodes/update", hidden: true });
  const list = h("ul", { class: "cards" });
  const more = button("", { class: "quiet", hidden: true, onclick: () => ((drawn += DRAWN), paint()) });
  const none = h("div", {});
  const detail = h("div", { class: "detail" });
  const linkless = noLink();
  const side = h("section", { class: "side", "aria-label": "Nodes" }, h("div", { class: "side-head" }, h("h2", {}, "Nodes"), total), linkless, filters.element, h("div", { class: "row tools-row" }, bulk.toggle), bulk.bar, h("p", { class: "side-news" }, updating), list, more, h("p", { class: "side-foot" }, h("a", { href: "#/nodes/next/provision" }, icon("nfc"), " Provision the next tapped node")));
  main.append(side, none, detail);
  let drawn = DRAWN;
  let listed = []; // the nodes that match the filters, in order
  let panel = null;
  let next = null; // the form for the next tapped node
  let firmware = null; // the update of several boards
  let chosen = rest;

  let first = null; // UUID of the first node: shown if none is chosen

  function paint() {
    const nodes = (listed = filters.of([...state.nodes.values()]).sort(order));
    first = nodes[0]?.uuid;
    const any = state.nodes.size > 0;
    side.hidden = !any;
    filters.element.hidden = state.nodes.size < SEARCH_FROM && !filters.on;
    bulk.toggle.hidden = state.nodes.size < 2;
    bulk.paint();
    news(latest());
    const strangers = state.status?.strangers ?? 0;
    const lacking = isLinkless();
    linkless.hidden = !lacking;
    const shown = state.total > state.nodes.size ? `${state.nodes.size} of ${count(state.total, "node")}` : count(state.nodes.size, "node");
    text(total, `${filters.on ? `${nodes.length} of ` : ""}${shown}${strangers ? `, ${strangers} more not on the whitelist` : ""}`);
    keyed(list, nodes.slice(0, drawn), (node) => node.uuid, (node) => card(node, bulk), update);
    values(); // a card that was filled anew has none
    more.hidden = nodes.length <= drawn;
    text(more.lastChild, `Show ${Math.min(DRAWN, nodes.length - drawn)} more of ${nodes.length}`);
    main.classList.toggle("one-open", Boolean(chosen[0]) && any);
    open();
    if (any || chosen[0]) none.replaceChildren();
    else if (!none.firstChild || none.dataset.loaded !== String(state.loaded)) {
      none.dataset.loaded = String(state.loaded);
      fill(none, state.loaded ? firstSteps() : h("p", { class: "empty" }, "Loading …"));
    }
    if (!any && state.loaded) {
      const unlinked = none.querySelector("[data-linkless]"); // absent while one node's page is open
      if (unlinked) unlinked.hidden = !lacking;
      const hidden = none.querySelector("[data-strangers]");
      if (hidden) hidden.hidden = !strangers;
      if (hidden && strangers) text(hidden, strangersWords(strangers));
    }
  }

  function news(update) {
    updating.hidden = !update || (update.state !== "running" && now() - update.ended > NEWS);
    if (!updating.hidden) text(updating, `Firmware update to ${update.image.version}: ${progressOf(update)}`);
  }

  function select() {
    if (!bulk.on) bulk.turn(true);
    location.hash = "#/nodes";
    bulk.every.focus();
  }

  function open() {
    if (chosen[0] === "update") {
      if (!firmware) {
        panel?.end();
        next?.end();
        panel = next = null;
        detail.replaceChildren();
        firmware = new UpdatePanel(detail, () => (bulk.on ? [...bulk.chosen] : []), select);
      }
      firmware.paint();
      return;
    }
    firmware?.end();
    firmware = null;
    if (chosen[0] === "next") {
      if (!next) {
        panel?.end();
        panel = null;
        detail.replaceChildren();
        next = new ProvisionTab(detail, "next");
      }
      return;
    }
    next?.end();
    next = null;
    const uuid = chosen[0] ?? first;
    const node = state.nodes.get(uuid);
    if (!node) {
      panel?.end();
      panel = null;
      if (chosen[0] && state.loaded) fill(detail, empty("Node not found.", h("p", {}, "Place it on the reader, or connect it and press Discover."), h("p", {}, h("a", { href: "#/nodes" }, "All nodes"))));
      else detail.replaceChildren();
      return;
    }
    if (panel?.uuid !== uuid) {
      panel?.end();
      panel = new NodePanel(detail, uuid);
    }
    panel.tab(chosen[1] ?? "live");
    panel.marked(state.tapped?.uuid === uuid && performance.now() - state.tapped.at < MARKED);
  }

  function update(element, node) {
    const current = (chosen[0] ?? first) === node.uuid;
    if (current) element.firstChild.setAttribute("aria-current", "true");
    else element.firstChild.removeAttribute("aria-current");
    element.classList.toggle("tapped", state.tapped?.uuid === node.uuid && performance.now() - state.tapped.at < MARKED);
    element.classList.toggle("absent", node.present === false);
    element.tick.hidden = !bulk.on;
    element.tick.firstChild.checked = bulk.chosen.has(node.uuid);
    element.tick.firstChild.setAttribute("aria-label", `Select ${nameOf(node)}`);
    const told = JSON.stringify([node.name, node.verdict, node.read?.at, node.unverified, node.from, node.busy, node.virtual, node.wrapped?.name, node.firmware, node.link, node.present, node.state, node.mode, node.power, node.groups, node.whitelisted, node.channels?.map((one) => one.name)]);
    if (element.told === told) return;
    element.told = told;
    const [tone, sign, words, why] = verdict(node);
    const values = (node.channels ?? []).filter((channel) => channel.kind !== "actuator").slice(0, SHOWN_VALUES);
    fill(
      element.firstChild,
      h("span", { class: "card-head" }, h("span", { class: "name" }, nameOf(node)), chip(tone, sign, words, why)),
      h("span", { class: "facts" }, facts(node)),
      values.length ? h("span", { class: "peek" }, values.map((channel) => h("span", { "data-channel": channel.number }, `${channelName(channel)} `, h("b", {}, "no value yet"), h("span", {}, channel.unit ? ` ${channel.unit}` : "")))) : null,
    );
  }

  function values() {
    for (const [uuid, element] of list.keyed ?? []) {
      const node = state.nodes.get(uuid);
      for (const peek of element.querySelectorAll("[data-channel]")) {
        const channel = node?.channels?.find((one) => one.number === Number(peek.dataset.channel));
        if (!channel) continue;
        const last = lastOf(uuid, channel);
        text(peek.querySelector("b"), figure(last, channel));
        peek.lastChild.hidden = typeof last?.value !== "number";
        peek.classList.toggle("stale", isStale(last));
      }
    }
  }

  const ends = [on("nodes status measurements tap route connection groups updates update", paint)];
  const ticking = setInterval(values, 250);
  const unmark = setInterval(() => state.tapped && paint(), 1000);
  paint();
  return {
    go(next) {
      const other = chosen[0] !== next[0];
      chosen = next;
      paint();
      if (other) window.scrollTo(0, 0);
    },
    end() {
      ends.forEach((end) => end());
      clearInterval(ticking);
      clearInterval(unmark);
      panel?.end();
      next?.end();
      firmware?.end();
    },
  };
}

function card(node, bulk) {
  const box = h("input", { type: "checkbox", onchange: () => bulk.choose(node.uuid, box.checked) });
  const tick = h("label", { class: "card-tick" }, box);
  const element = h("li", { class: "card" }, h("a", { href: `#/nodes/${node.uuid}` }), tick);
  element.tick = tick;
  return element;
}

const strangersWords = (many) => `${count(many, "node")} answered but ${many === 1 ? "is" : "are"} not on the whitelist. Place a node on the reader to add it, or switch detection to Transparent to see them all.`;

function firstSteps() {
  return h(
    "section",
    { class: "first" },
    h("h2", {}, "No nodes yet"),
    h("p", { class: "warn-line", "data-strangers": true, hidden: true }),
    noLink(),
    h(
      "ol",
      {},
      h("li", {}, icon("nfc"), h("div", {}, h("strong", {}, "Place a node on the NFC reader."), h("p", {}, "It opens here automatically. "), h("p", {}, h("a", { href: "#/nodes/next/provision" }, "Provision the next tapped node")))),
      h("li", {}, icon("can"), h("div", {}, h("strong", {}, "Or connect a node to the bus."), h("p", {}, "It announces itself. To look for it now, press Discover above."))),
      h("li", {}, icon("virtual"), h("div", {}, h("strong", {}, "No node at hand? "), h("a", { href: "#/virtual" }, "Create a virtual transducer"), h("p", {}, "It behaves like a real node."))),
    ),
  );
}

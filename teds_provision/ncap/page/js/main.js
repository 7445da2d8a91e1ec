// Starts the page: header, connection, and the view named by the address.

import { change, post } from "./api.js";
import { button, fill, h, icon, say, text, toast, trouble } from "./dom.js";
import { count, nameOf } from "./format.js";
import { Live } from "./live.js";
import { changed, on, refresh, state, take } from "./state.js";
import { isLinkless, noLink } from "./views/links.js";
import { logView } from "./views/log.js";
import { measureView } from "./views/measure.js";
import { nodesView } from "./views/nodes.js";
import { stationView } from "./views/station.js";
import { virtualView } from "./views/virtual.js";

const VIEWS = {
  nodes: ["Nodes", nodesView],
  measure: ["Measure", measureView],
  virtual: ["Virtual", virtualView],
  log: ["Log", logView],
  station: ["Station", stationView],
};
const STATUS_EVERY = 2000; // ms

let shown = { name: null, view: null };

function route() {
  const [name, ...rest] = location.hash.replace(/^#\/?/, "").split("/"); // views and hex digits need no decoding
  return Object.hasOwn(VIEWS, name) ? { name, rest } : { name: "nodes", rest: [] };
}

function show() {
  const { name, rest } = route();
  if (shown.name === name && shown.view.go) {
    shown.view.go(rest);
    return;
  }
  shown.view?.end?.();
  const main = document.getElementById("main");
  main.replaceChildren();
  main.className = `view-${name}`;
  const [title, make] = VIEWS[name];
  shown = { name, view: make(main, rest) };
  document.title = `${title} – base station`;
  changed("route");
}

function header() {
  const title = h("h1", {}, "Base station");
  const pill = h("span", { class: "pill", id: "connection" });
  const modes = h("div", { class: "switch", role: "group", "aria-label": "Detection" });
  const explained = {
    whitelist: "Open only nodes on the whitelist; count the others.",
    transparent: "Read and show every node found.",
  };
  const choices = Object.entries(explained).map(([mode, why]) =>
    button(mode === "whitelist" ? "Whitelist" : "Transparent", {
      title: why,
      "data-mode": mode,
      onclick: () => detect(mode, why),
    }),
  );
  modes.append(...choices);
  const discover = button("Discover", { id: "discover", title: "Look for nodes on every link now." }, "wave");
  discover.addEventListener("click", () => discover.busy(find));
  const nav = h("nav", { "aria-label": "Views" });
  const links = Object.entries(VIEWS).map(([name, [words]]) => h("a", { href: `#/${name}`, "data-view": name }, words));
  nav.append(...links);
  const bar = document.getElementById("bar");
  fill(bar, h("div", { class: "who" }, title, pill), nav, h("div", { class: "tools" }, h("span", { class: "tool-label" }, "Detection"), modes, discover));

  on("status connection route", () => {
    text(title, state.status?.station?.name ? `Base station ${state.status.station.name}` : "Base station");
    for (const choice of choices) choice.setAttribute("aria-pressed", String(state.status?.detection === choice.dataset.mode));
    for (const control of [...choices, discover]) {
      if (control.getAttribute("aria-busy") !== "true") control.disabled = state.connection !== "live" || state.status?.write === false;
    }
    for (const link of links) {
      if (link.dataset.view === route().name) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    connection(pill);
  });
}

function connection(pill) {
  const [tone, sign, words] = {
    connecting: ["plain", "clock", "Connecting"],
    live: ["good", "good", "Live"],
    lost: ["bad", "bad", "Connection lost"],
    "signed out": ["bad", "bad", "Signed out"],
  }[state.connection];
  pill.className = `pill ${tone}`;
  if (pill.textContent !== words) fill(pill, icon(sign), h("span", {}, words));
  document.body.classList.toggle("lost", state.connection !== "live");
  const banner = document.getElementById("banner");
  if (state.connection === "lost") {
    text(banner, "Connection to the base station lost. These values are out of date. Reconnecting …");
  } else if (state.connection === "signed out") {
    if (!banner.firstElementChild) {
      fill(banner, "This browser is no longer signed in. Open the address that this command prints: ", h("code", {}, "teds-provision ncap open"));
    }
  } else text(banner, state.status?.vaultProblem ? `The vault is locked. ${state.status.vaultProblem}` : "");
}

async function detect(mode, why) {
  try {
    await change("detection", { mode });
    say(`Detection: ${mode}. ${why}`);
    await refresh("status", "nodes");
  } catch (error) {
    toast("bad", error.message, error.hint);
  }
}

async function find() {
  say("Looking for nodes on every link.");
  try {
    const { nodes } = await post("discover");
    await refresh("nodes", "status");
    const words = nodes?.length ? `${count(nodes.length, "node")} answered.` : "No node answered.";
    toast("good", words, nodes?.length ? "" : isLinkless() ? noLink().textContent : "Is it powered and on the bus? A node with NFC is found when you place it on the reader.");
  } catch (error) {
    toast("bad", error.message, error.hint);
  }
}

/** What the user is doing that must not be interrupted; "" if nothing. */
function occupied() {
  if (document.querySelector("[data-held]")) return "you are holding an actuator";
  const at = document.activeElement;
  const typing = at?.matches?.("main input:not([type=checkbox], [type=range], [type=file])") && at.value !== at.defaultValue;
  return typing ? "you are typing" : "";
}

/** A tap opens and marks that node, whatever page is shown: no click is needed. */
function tapped() {
  const { uuid } = state.tapped;
  const node = state.nodes.get(uuid);
  say(`Tapped: ${nameOf(node ?? { uuid })}.`);
  const here = location.hash.startsWith(`#/nodes/${uuid}`);
  const busy = occupied();
  if (busy) {
    toast("good", `Tapped: ${nameOf(node ?? { uuid })}.`, `Not opened because ${busy}. It is marked under Nodes.`);
    return;
  }
  const run = state.runs.get(uuid) ?? state.runs.get("next");
  // A whole provisioning may end before this frame, and the user wants to see its result.
  const asked = ["waiting", "running"].includes(run?.state) || performance.now() - (run?.heard ?? -Infinity) < 3000;
  // Only if nothing else is open: a tap must not take away the plot or node that the user is looking at.
  const free = /^#?\/?(nodes\/?)?$/.test(location.hash) || location.hash.startsWith("#/nodes/next");
  if (asked && (free || here)) location.hash = `#/nodes/${uuid}/provision`;
  else if (free) location.hash = `#/nodes/${uuid}`;
  else if (!here) toast("good", `Tapped: ${nameOf(node ?? { uuid })}.`, h("a", { href: `#/nodes/${uuid}` }, "Open it"));
  changed("nodes");
}

function start() {
  header();
  window.addEventListener("hashchange", show);
  on("tap", tapped);
  show();
  new Live({
    state: (word, refusal = null) => {
      if (state.connection === word) return;
      state.connection = word;
      state.refusal = refusal;
      state.since = performance.now();
      if (word === "lost") say("Connection lost.");
      if (word === "live") say("Connected.");
      changed("connection");
    },
    event: take,
  });
  setInterval(() => {
    if (state.connection === "live" && !document.hidden) refresh("status");
  }, STATUS_EVERY);
}

window.addEventListener("unhandledrejection", (event) => {
  if (event.reason?.name !== "AbortError") toast("bad", event.reason?.message ?? String(event.reason));
});

if (window.uPlot) start();
else fill(document.getElementById("main"), trouble({ message: "A file of this page could not be loaded: vendor/uPlot.iife.min.js.", hint: "Reinstall teds-provision." }));

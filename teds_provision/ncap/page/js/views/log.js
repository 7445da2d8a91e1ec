// The audit log: actions, actors, refusals, and whether its chain is intact. The station does the searching.

import { get } from "../api.js";
import { button, chip, empty, fill, h, keyed, text, trouble } from "../dom.js";
import { clock, count, nameOf } from "../format.js";
import { now, on, state } from "../state.js";

const EVERY = 5000; // ms between two requests for new entries
const PAGE = 200; // entries in one answer
const TIMES = [["All entries", 0], ["Last hour", 3600], ["Last day", 86400], ["Last 7 days", 604800]]; // s
const TYPING = 250; // ms after the last key stroke before the search is sent

export function logView(main) {
  const search = h("input", { type: "search", placeholder: "Action, node or text", "aria-label": "Search the log", maxlength: "200" });
  const failed = h("input", { type: "checkbox" });
  const since = h("select", { "aria-label": "Time" }, TIMES.map(([words, seconds]) => h("option", { value: seconds }, words)));
  const intact = h("span", {});
  const rows = h("tbody", {});
  const none = h("div", {});
  const total = h("span", { class: "hint" });
  const table = h("table", { class: "log" }, h("caption", { class: "unseen" }, "Audit log, newest first"), h("thead", {}, h("tr", {}, ["Time", "Action", "Node", "Details", "By"].map((words) => h("th", { scope: "col" }, words)))), rows);
  const older = button("Show older entries", { onclick: () => older.busy(() => load(Math.min(...entries.keys()))) });
  main.append(h("div", { class: "panel-head view-head" }, h("h2", {}, "Log"), intact, search, since, h("label", { class: "tick" }, failed, h("span", {}, "Failures only")), total), h("section", { class: "panel", "aria-label": "Audit log" }, none, h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Audit log" }, table), h("div", { class: "row" }, older)));

  let entries = new Map(); // by sequence number: entries for the present search
  let asked = null; // the search to which they belong
  let more = false; // true if the station has older ones
  let told = null; // the latest answer
  let typing = null;

  /** Fetch the newest entries, or those before a number; answers to an earlier search are dropped. */
  async function load(before = null) {
    const words = new URLSearchParams({ limit: PAGE });
    if (search.value.trim()) words.set("text", search.value.trim());
    if (failed.checked) words.set("failed", "1");
    if (Number(since.value)) words.set("since", Math.floor((now() - Number(since.value)) / 60) * 60);
    const query = words.toString();
    if (before !== null) words.set("before", before);
    if (asked !== query) more = false;
    asked = query;
    try {
      const answer = await get(`log?${words}`);
      if (asked !== query) return;
      if (entries.query !== query) {
        entries = new Map();
        entries.query = query;
      }
      if (before !== null || !entries.size) more = answer.entries.length === PAGE;
      answer.entries.forEach((one) => entries.set(one.seq, one));
      told = answer;
      paint();
    } catch (error) {
      if (state.connection === "live") fill(none, trouble(error));
    }
  }

  function paint() {
    if (!told) return;
    const found = [...entries.values()].sort((one, other) => other.seq - one.seq);
    const all = !search.value.trim() && !failed.checked && !Number(since.value);
    keyed(rows, found, (one) => one.seq, line, (element, one) => one.uuid && text(element.querySelector("a"), nameOf(state.nodes.get(one.uuid) ?? one)));
    const shown = told.intact ? ["good", "good", "Chain intact"] : ["bad", "bad", "Chain broken: the log was altered"];
    if (intact.textContent !== shown[2]) fill(intact, chip(...shown));
    intact.title = told.why ?? "";
    text(total, more ? `Newest ${count(found.length, "entry", "entries")}` : count(found.length, "entry", "entries"));
    table.hidden = !found.length;
    older.hidden = !more;
    if (found.length) none.replaceChildren();
    else fill(none, empty(all ? "The log is empty." : "No matching entries.", h("p", {}, all ? "Every change and every refusal is recorded here." : "Try another search, or clear the filter.")));
  }

  search.addEventListener("input", () => {
    clearTimeout(typing);
    typing = setTimeout(() => load(), TYPING);
  });
  failed.addEventListener("change", () => load());
  since.addEventListener("change", () => load());
  older.hidden = table.hidden = true;
  const offs = [on("log", () => load()), on("nodes", paint)];
  const ticking = setInterval(() => !document.hidden && state.connection === "live" && load(), EVERY);
  load();
  return {
    end() {
      offs.forEach((off) => off());
      clearTimeout(typing);
      clearInterval(ticking);
    },
  };
}

function line(one) {
  const node = one.uuid ? (state.nodes.get(one.uuid) ?? { uuid: one.uuid }) : null;
  return h(
    "tr",
    { class: one.failed ? "failed" : "" },
    h("td", { class: "time" }, clock(one.time)),
    h("th", { scope: "row" }, one.act, one.failed ? [" ", chip("bad", "bad", "failed")] : null),
    h("td", {}, node ? h("a", { href: `#/nodes/${node.uuid}` }, nameOf(node)) : ""),
    h("td", {}, one.detail ?? ""),
    h("td", { class: "hint" }, one.actor ?? one.who ?? ""),
  );
}

// The audit log: what was done, by whom it was refused, and whether its chain holds.

import { chip, empty, fill, h, keyed, text } from "../dom.js";
import { clock, count, nameOf } from "../format.js";
import { on, refresh, state } from "../state.js";

const EVERY = 5000; // ms

export function logView(main) {
  const search = h("input", { type: "search", placeholder: "Act, node, word", "aria-label": "Find in the log", oninput: () => paint() });
  const failed = h("input", { type: "checkbox", onchange: () => paint() });
  const intact = h("span", {});
  const rows = h("tbody", {});
  const none = h("div", {});
  const total = h("span", { class: "hint" });
  const table = h("table", { class: "log" }, h("caption", { class: "unseen" }, "Audit log, newest first"), h("thead", {}, h("tr", {}, ["Time", "Act", "Node", "What", "Who"].map((words) => h("th", { scope: "col" }, words)))), rows);
  main.append(h("div", { class: "panel-head view-head" }, h("h2", {}, "Log"), intact, search, h("label", { class: "tick" }, failed, h("span", {}, "Failures only")), total), h("section", { class: "panel", "aria-label": "Audit log" }, none, h("div", { class: "scroll", tabindex: "0", role: "group", "aria-label": "Audit log" }, table)));

  function paint() {
    const entries = [...(state.log.entries ?? [])].sort((one, other) => other.seq - one.seq);
    const words = search.value.trim().toLowerCase();
    const found = entries.filter((one) => (!failed.checked || one.failed) && (!words || JSON.stringify(one).toLowerCase().includes(words)));
    keyed(rows, found, (one) => one.seq, line);
    const holds = state.log.intact;
    const shown = holds === true ? ["good", "good", "Chain holds"] : holds === false ? ["bad", "bad", "Chain broken: the log was changed"] : ["plain", "ask", "Not checked"];
    if (intact.textContent !== shown[2]) fill(intact, chip(...shown));
    intact.title = state.log.why ?? "";
    text(total, count(found.length, "entry", "entries"));
    table.hidden = !found.length;
    if (found.length) none.replaceChildren();
    else fill(none, empty(entries.length ? "Nothing matches." : "Nothing was done yet.", h("p", {}, entries.length ? "Take another word, or show all." : "Every change and every refusal will stand here.")));
  }

  const off = on("log", paint);
  const ticking = setInterval(() => !document.hidden && state.connection === "live" && refresh("log"), EVERY);
  refresh("log");
  paint();
  return {
    end() {
      off();
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

// The history of a node at this station: verdicts, sessions, writes, refusals; from the audit log.

import { get } from "../api.js";
import { button, chip, empty, fill, h, trouble } from "../dom.js";
import { clock, count } from "../format.js";
import { on } from "../state.js";

const PAGE = 50; // entries in one answer

export class HistoryTab {
  constructor(parent, uuid) {
    this.uuid = uuid;
    this.entries = new Map(); // by sequence number
    this.list = h("ol", { class: "history", "aria-label": "History" });
    this.none = h("div", {});
    this.total = h("span", { class: "hint" });
    this.older = button("Show older entries", { hidden: true, onclick: () => this.older.busy(() => this.load(Math.min(...this.entries.keys()))) });
    parent.append(h("section", { class: "panel", "aria-label": "History" }, h("div", { class: "panel-head" }, h("h3", {}, "History"), this.total), this.none, this.list, h("div", { class: "row" }, this.older)));
    this.off = on("log nodes", () => this.soon());
    this.load();
  }

  /** Events come in bursts. */
  soon() {
    this.waiting ??= setTimeout(() => {
      this.waiting = null;
      this.load();
    }, 1000);
  }

  async load(before = null) {
    const words = new URLSearchParams({ limit: PAGE, uuid: this.uuid });
    if (before !== null) words.set("before", before);
    try {
      const { entries } = await get(`log?${words}`);
      if (before !== null || !this.entries.size) this.older.hidden = entries.length < PAGE;
      entries.forEach((one) => this.entries.set(one.seq, one));
      this.paint();
    } catch (error) {
      if (!this.entries.size) fill(this.none, error.status === 404 ? empty("No history for this node yet.") : trouble(error));
    }
  }

  paint() {
    const found = [...this.entries.values()].sort((one, other) => other.seq - one.seq);
    if (this.shown === found.length) return;
    this.shown = found.length;
    fill(this.total, this.older.hidden ? count(found.length, "entry", "entries") : `Newest ${count(found.length, "entry", "entries")}`);
    if (found.length) this.none.replaceChildren();
    else fill(this.none, empty("No history for this node yet."));
    fill(this.list, found.map((one) =>
      h("li", { class: one.failed ? "failed" : "" }, h("span", { class: "time" }, clock(one.time)), h("strong", {}, one.act), one.failed ? chip("bad", "bad", "failed") : null, h("span", { class: "grow" }, one.detail ?? ""), h("span", { class: "hint" }, one.actor ?? one.who ?? "")),
    ));
  }

  end() {
    this.off();
    clearTimeout(this.waiting);
  }
}

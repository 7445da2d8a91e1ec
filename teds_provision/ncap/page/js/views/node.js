// One node: its identity, and its three tabs.

import { paths, post } from "../api.js";
import { button, chip, fill, h, icon, keyed, say, text, trouble } from "../dom.js";
import { grouped, nameOf, verdict } from "../format.js";
import { on, state } from "../state.js";
import { DatasheetTab } from "./datasheet.js";
import { facts, checkLine } from "./facts.js";
import { HistoryTab } from "./history.js";
import { LiveTab } from "./values.js";
import { ProvisionTab } from "./provision.js";

const TABS = { live: ["Live", LiveTab], datasheet: ["Datasheet", DatasheetTab], provision: ["Provision", ProvisionTab], history: ["History", HistoryTab] };

export class NodePanel {
  constructor(parent, uuid) {
    this.uuid = uuid;
    this.open = null;
    this.title = h("h2", { tabindex: "-1" });
    this.head = h("div", { class: "node-facts" });
    this.locate = button("Locate", { class: "quiet", title: "Make the board blink or beep for 10 seconds.", onclick: () => this.blink() });
    this.error = h("div", { role: "alert" });
    this.checks = h("details", { class: "checks" }, h("summary", {}), h("ul", {}));
    this.tabs = h(
      "nav",
      { class: "tabs", "aria-label": "Node views" },
      Object.entries(TABS).map(([name, [words]]) => h("a", { href: `#/nodes/${uuid}/${name}`, "data-tab": name }, words)),
    );
    this.body = h("div", { class: "tab" });
    this.header = h(
      "header",
      { class: "node-head" },
      h("a", { class: "back", href: "#/nodes" }, "All nodes"),
      this.title,
      h("p", { class: "uuid", title: "UUID" }, grouped(uuid)),
      this.head,
      h("p", {}, this.locate),
      this.error,
      this.checks,
    );
    fill(parent, this.header, this.tabs, this.body);
    this.stop = on("nodes connection", () => this.paint());
    this.paint();
  }

  get node() {
    return state.nodes.get(this.uuid);
  }

  paint() {
    const node = this.node;
    if (!node) return;
    text(this.title, nameOf(node));
    this.locate.disabled = state.connection !== "live" || state.status?.write === false || node.present === false;
    const [tone, sign, words, why] = verdict(node);
    const heard = node.heard && node.heard.verdict !== node.verdict ? chip("warn", "ask", `Not verified: ${node.heard.verdict}`, "The node sent this outside a session, where anyone on the link could have sent it. It changes nothing.") : null;
    const kept = node.from === "kept" ? chip("plain", "clock", "Kept", "The node has restarted since its datasheet was read. The rest is being read again.") : null;
    fill(this.head, chip(tone, sign, words, why), kept, heard, node.whitelisted ? chip("plain", "list", "On the whitelist") : null, facts(node), node.why ? h("span", { class: "warn" }, icon("warn"), node.why, node.cure ? ` ${node.cure}` : "") : null);
    const checks = node.checks ?? [];
    this.checks.hidden = !checks.length && !node.fingerprint;
    const passed = checks.filter((check) => check.result === "passed").length;
    text(this.checks.firstChild, checks.length ? `Security check: ${passed} of ${checks.filter((one) => one.result !== "skipped").length} passed` : "Key");
    keyed(this.checks.lastChild, [...checks, ...(node.fingerprint ? [{ name: "fingerprint", print: node.fingerprint }] : [])], (check) => check.name + (check.result ?? "") + (check.why ?? ""), checkLine);
  }

  async blink() {
    this.error.replaceChildren();
    try {
      await post(paths.locate(this.uuid), { seconds: 10 });
      say("The board blinks for 10 seconds.");
    } catch (error) {
      fill(this.error, trouble(error));
    }
  }

  tab(name) {
    const known = Object.hasOwn(TABS, name) ? name : "live";
    for (const link of this.tabs.children) {
      if (link.dataset.tab === known) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    if (this.open?.name === known) return;
    this.open?.tab.end();
    this.body.replaceChildren();
    this.open = { name: known, tab: new TABS[known][1](this.body, this.uuid) };
  }

  marked(yes) {
    if (yes && !this.header.classList.contains("tapped")) this.title.focus({ preventScroll: true });
    this.header.classList.toggle("tapped", yes);
  }

  end() {
    this.stop();
    this.open?.tab.end();
  }
}

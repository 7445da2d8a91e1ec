// One action for many nodes: a refusal does not stop the others, and is listed with its reason.

import { change, get, paths, post } from "../api.js";
import { button, fill, h, say, text } from "../dom.js";
import { count, nameOf } from "../format.js";
import { refresh, state } from "../state.js";

const AT_ONCE = 4; // nodes worked on at once

export class Bulk {
  /** `shown` returns the nodes in the list; `changed` is called when the selection changes. */
  constructor(shown, changed) {
    this.chosen = new Set();
    this.shown = shown;
    this.changed = changed;
    this.toggle = button("Select", { "aria-pressed": "false", onclick: () => this.turn(!this.on) }, "list");
    this.total = h("strong", {});
    this.every = button("All listed", { onclick: () => this.all() });
    this.verify = button("Verify", { onclick: () => this.verify.busy(() => this.verified()) }, "good");
    this.group = h("input", { type: "text", maxlength: "64", autocomplete: "off", placeholder: "Group", "aria-label": "Group to add to", list: "groups-known", class: "narrow" });
    this.known = h("datalist", { id: "groups-known" });
    this.add = button("Add to group", { onclick: () => this.add.busy(() => this.added()) }, "plus");
    this.start = button("Measure", { onclick: () => this.start.busy(() => this.measured()) }, "play");
    this.firmware = button("Update firmware", { onclick: () => (location.hash = "#/nodes/update") }, "chip");
    this.result = h("div", { class: "bulk-result", role: "status" });
    this.bar = h("div", { class: "bulk panel", role: "group", "aria-label": "Selected nodes", hidden: true }, h("div", { class: "row" }, this.total, this.every), h("div", { class: "row" }, this.verify, this.start, this.firmware), h("div", { class: "row" }, this.group, this.known, this.add), this.result);
  }

  get on() {
    return !this.bar.hidden;
  }

  turn(on) {
    this.bar.hidden = !on;
    this.chosen.clear();
    this.result.replaceChildren();
    this.toggle.setAttribute("aria-pressed", String(on));
    this.changed();
  }

  all() {
    const shown = this.shown();
    const every = shown.every((node) => this.chosen.has(node.uuid));
    shown.forEach((node) => (every ? this.chosen.delete(node.uuid) : this.chosen.add(node.uuid)));
    this.changed();
  }

  choose(uuid, yes) {
    if (yes) this.chosen.add(uuid);
    else this.chosen.delete(uuid);
    this.changed();
  }

  /** Deselect nodes that the station no longer knows; nodes hidden by a filter remain selected. */
  paint() {
    for (const uuid of this.chosen) if (!state.nodes.has(uuid)) this.chosen.delete(uuid);
    const hidden = this.chosen.size - this.shown().filter((node) => this.chosen.has(node.uuid)).length;
    text(this.total, `${count(this.chosen.size, "node")} selected${hidden ? `, ${hidden} of them not listed` : ""}`);
    const may = state.connection === "live" && state.status?.write !== false;
    for (const act of [this.verify, this.add, this.start, this.firmware]) {
      if (act.getAttribute("aria-busy") !== "true") act.disabled = !this.chosen.size || (act !== this.verify && !may);
    }
    const names = state.groups.map((group) => group.name);
    if (this.known.told !== names.join("\n")) fill(this.known, names.map((name) => h("option", { value: name })));
    this.known.told = names.join("\n");
  }

  /** Do `work` for each selected node; then report how many are done, and each refusal with its reason. */
  async each(verb, work) {
    const waiting = [...this.chosen];
    const [total, refused] = [waiting.length, []];
    let done = 0;
    const told = () => text(this.result, `${verb} ${done} of ${total} …`);
    told();
    const one = async () => {
      for (let uuid = waiting.shift(); uuid; uuid = waiting.shift()) {
        try {
          await work(uuid);
        } catch (error) {
          refused.push([uuid, error.message]);
        }
        done += 1;
        told();
      }
    };
    await Promise.all(Array.from({ length: AT_ONCE }, one));
    this.tell(`${verb} ${total - refused.length} of ${total}.`, refused);
  }

  tell(words, refused = []) {
    fill(this.result, h("p", {}, words), refused.length ? h("ul", { class: "refused" }, refused.map(([uuid, why]) => h("li", {}, h("a", { href: `#/nodes/${uuid}` }, nameOf(state.nodes.get(uuid) ?? { uuid })), `: ${why}`))) : null);
    say(words);
  }

  async verified() {
    await this.each("Verified", async (uuid) => {
      const sheet = await get(paths.teds(uuid));
      if (sheet.verdict && sheet.verdict !== "authentic") throw new Error(sheet.verdict);
    });
    await refresh("nodes");
  }

  async added() {
    const name = this.group.value.trim();
    if (!name) return this.tell("Enter the name of a group.");
    const group = state.groups.find((one) => one.name === name);
    const uuids = [...new Set([...(group?.uuids ?? []), ...this.chosen])];
    return this.whole(() => (group ? change(paths.group(name), { uuids }) : post("groups", { name, uuids })), `Group ${name} has ${count(uuids.length, "node")}.`, "groups");
  }

  async measured() {
    const uuids = [...this.chosen];
    return this.whole(() => post("measurements", { uuids }), `Measuring ${count(uuids.length, "node")}.`, "measurements");
  }

  /** An action for all of them at once. */
  async whole(work, words, list) {
    try {
      await work();
      this.tell(words);
      await refresh(list, "nodes");
    } catch (error) {
      this.tell(`${error.message}${error.hint ? ` ${error.hint}` : ""}`);
    }
  }
}

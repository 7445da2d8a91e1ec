// Write a datasheet from a file: show the changes in physical units, then sign and write it.

import { change, paths } from "../api.js";
import { button, chip, field, fill, h, icon, say, trouble } from "../dom.js";
import { channelName, count, nameOf } from "../format.js";
import { frozenBy, on, state } from "../state.js";

const LARGEST = 900000; // octets: the station takes bodies of at most 1 MiB

/** Name of a change, as in the diff's sentence: "stated uncertainty" rather than OError. */
function labelOf(one) {
  const end = ` ${one.before} -> ${one.after}.`;
  if (!one.text?.endsWith(end)) return one.field;
  const head = one.text.slice(0, -end.length);
  return head.slice(head.lastIndexOf(": ") + 2) || one.field;
}

export class WritePanel {
  constructor(uuid, written) {
    this.uuid = uuid;
    this.written = written;
    this.leaving = new AbortController();
    this.file = h("input", { type: "file", class: "unseen-input", accept: ".xml,.json,application/xml,application/json", id: `file-${uuid}` });
    this.file.addEventListener("change", () => this.take(this.file.files[0]));
    this.drop = h("label", { class: "drop", for: this.file.id }, icon("plus"), h("span", {}, h("strong", {}, "Choose a datasheet file"), " or drop it here. XML or JSON."));
    for (const name of ["dragenter", "dragover"]) this.drop.addEventListener(name, (event) => this.over(event, true));
    for (const name of ["dragleave", "drop"]) this.drop.addEventListener(name, (event) => this.over(event, false));
    this.drop.addEventListener("drop", (event) => this.take(event.dataTransfer.files[0]));
    this.result = h("div", { class: "plan" });
    this.frozen = h("p", { class: "hint" });
    this.element = h(
      "section",
      { class: "panel", "aria-label": "Write a datasheet" },
      h("h3", {}, "Write a datasheet"),
      h("p", { class: "hint" }, "You will see the changes before anything is written."),
      this.file,
      this.drop,
      this.frozen,
      this.result,
    );
    this.off = on("measurements status", () => this.paint());
    this.paint();
  }

  over(event, yes) {
    event.preventDefault();
    this.drop.classList.toggle("over", yes);
  }

  paint() {
    const frozen = frozenBy(this.uuid);
    const blocked = frozen ? `${frozen} Until then its datasheet is frozen.` : state.status?.write === false ? "This browser has read-only access." : "";
    this.frozen.textContent = blocked;
    this.file.disabled = Boolean(blocked) || state.connection !== "live";
    this.drop.classList.toggle("off", this.file.disabled);
    if (this.go && this.go.getAttribute("aria-busy") !== "true") this.go.disabled = this.file.disabled;
  }

  async take(file) {
    this.file.value = "";
    if (!file || this.file.disabled) return;
    if (file.size > LARGEST) {
      fill(this.result, trouble({ message: `${file.name} is too large for a datasheet (${file.size} bytes).`, hint: "Choose the XML or JSON datasheet of one node." }));
      return;
    }
    const content = await file.text();
    await this.compare(file.name, { format: content.trimStart().startsWith("<") ? "xml" : "json", content });
  }

  async compare(name, body) {
    fill(this.result, h("p", { class: "busy-line" }, `Comparing ${name} with the node's datasheet …`));
    try {
      const plan = await change(`${paths.teds(this.uuid)}?dry_run=1`, body, { signal: this.leaving.signal });
      this.plan(name, body, plan);
    } catch (error) {
      if (error.name === "AbortError") return;
      if (error.hint.includes("--accept-calibration")) this.unlikely(name, body, error);
      else if (error.code === "wrong-board") this.otherType(name, body, error);
      else fill(this.result, trouble(error));
    }
  }

  /** A board becomes another type only if the user confirms that. */
  otherType(name, body, error) {
    const again = button("Change its type and compare", {}, "ask");
    again.addEventListener("click", () => this.compare(name, { ...body, retype: true }));
    fill(this.result, trouble({ message: error.message, hint: "Choose the datasheet of this board, or connect the right board." }), h("div", { class: "row" }, again));
  }

  /** A suspicious calibration is written only with a reason, which is logged. */
  unlikely(name, body, error) {
    const reason = h("input", { type: "text", maxlength: "200", autocomplete: "off" });
    const again = button("Accept and compare again", {}, "ask");
    again.addEventListener("click", () => reason.value.trim() && this.compare(name, { ...body, accept_calibration: reason.value.trim() }));
    fill(this.result, trouble({ message: error.message, hint: "Fix the file, or give a reason to accept it. The reason goes into the log." }), h("div", { class: "row" }, field("Reason to accept it", reason), again));
  }

  plan(name, body, plan) {
    const node = state.nodes.get(this.uuid);
    const changes = plan.changes ?? [];
    const guard = plan.guard ?? [];
    this.go = button(`Sign and write to ${nameOf(node)}`, { class: "main" }, "good");
    this.go.addEventListener("click", () => this.go.busy(() => this.carry(name, body, plan)));
    const no = button("Cancel", { onclick: () => this.clear() });
    fill(
      this.result,
      h("h4", {}, changes.length ? `${name}: ${count(changes.length, "change")}` : `${name}: nothing to change`),
      guard.length ? h("ul", { class: "guard" }, guard.map((one) => h("li", {}, chip(one.severity === "error" ? "bad" : "warn", "warn", one.severity ?? "warning"), h("span", {}, one.message, one.hint ? h("span", { class: "hint" }, ` ${one.hint}`) : null)))) : null,
      changes.length ? this.table(changes, node) : h("p", {}, "The node already has this datasheet."),
      changes.length ? h("div", { class: "row" }, this.go, no) : h("div", { class: "row" }, no),
    );
    say(changes.length ? `${count(changes.length, "change")} to review.` : "Nothing to change.");
    this.paint();
  }

  table(changes, node) {
    const where = (one) => {
      if (one.channel === 0) return "Node";
      const channel = node?.channels?.find((each) => each.number === one.channel);
      return channel ? channelName(channel) : `channel ${one.channel}`;
    };
    const rows = changes.map((one) =>
      one.before || one.after
        ? h("tr", {}, h("th", { scope: "row" }, where(one)), h("td", {}, labelOf(one)), h("td", { class: "before", "data-label": "now" }, one.before || "nothing"), h("td", { class: "after", "data-label": "then" }, h("span", { class: "arrow", "aria-hidden": "true" }, "→ "), one.after || "nothing"))
        : h("tr", {}, h("th", { scope: "row" }, where(one)), h("td", { colspan: "3" }, one.text)),
    );
    return h(
      "div",
      { class: "scroll", tabindex: "0", role: "group", "aria-label": "What changes" },
      h("table", { class: "diff" }, h("caption", { class: "unseen" }, "What changes, in physical units"), h("thead", {}, h("tr", {}, ["Where", "What", "Now on the node", "After writing"].map((words) => h("th", { scope: "col" }, words)))), h("tbody", {}, rows)),
    );
  }

  async carry(name, body, reviewed) {
    try {
      const done = await change(paths.teds(this.uuid), body, { match: reviewed.tag });
      fill(this.result, h("p", { class: "done" }, chip("good", "good", "Written"), ` Signed, written and verified${done.verdict ? `: ${done.verdict}` : ""}.`));
      this.go = null;
      say("Datasheet written and verified.");
      this.written();
    } catch (error) {
      if (error.status !== 412) return fill(this.result, trouble(error));
      await this.compare(name, body); // another client wrote meanwhile: show the changes again before writing
      this.result.prepend(trouble({ message: "The datasheet on the node has changed since.", hint: "Review the changes again." }));
    }
  }

  clear() {
    this.go = null;
    this.result.replaceChildren();
  }

  end() {
    this.leaving.abort();
    this.off();
  }
}

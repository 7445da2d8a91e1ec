// New firmware for the selected boards: image, plan, questions, progress, and each board's result.

import { paths, remove, send } from "../api.js";
import { button, chip, field, fill, h, icon, keyed, say, text, trouble } from "../dom.js";
import { clock, count, nameOf, short } from "../format.js";
import { on, refresh, state } from "../state.js";

const LARGEST = 4 << 20; // octets that the station takes
const PATIENCE = 600000; // ms: planning contacts every board
const RESULTS = {
  updated: ["good", "good", "updated"],
  already: ["plain", "good", "runs it already"],
  reverted: ["bad", "warn", "reverted"],
  refused: ["bad", "bad", "refused"],
  lost: ["bad", "warn", "lost"],
};
const STEPS = { upload: "uploading", restart: "restarting", prove: "proving itself", revert: "going back" };
const PLANS = { upload: "Installs", restart: "Restarts with", prove: "Proves and keeps", nothing: "Runs it already:" };

/** The running update, or else the latest finished one; null if there was none. */
export const latest = () => state.updates.find((one) => one.state === "running") ?? state.updates[0] ?? null;

/** "2 of 3 boards done". */
export const progressOf = (update) => `${update.boards.filter((one) => one.result || one.state === "skipped").length} of ${count(update.boards.length, "board")} done`;

const called = (uuid) => nameOf(state.nodes.get(uuid) ?? { uuid });

export class UpdatePanel {
  /** `chosen` returns the UUIDs selected in the list; `select` lets the user select some. */
  constructor(parent, chosen, select) {
    this.chosen = chosen;
    this.leaving = new AbortController();
    this.image = null; // {name, octets}: the planned octets are sent, even if the file changes
    this.plan = null;
    this.file = h("input", { type: "file", class: "unseen-input", accept: ".bin,application/octet-stream", id: "firmware-image", onchange: () => this.take(this.file.files[0]) });
    this.fileName = h("strong", {}, "Choose a firmware image");
    this.drop = h("label", { class: "drop", for: this.file.id }, icon("plus"), h("span", {}, this.fileName, " or drop one here. The file that imgtool sign wrote, at most 4 MiB."));
    for (const name of ["dragenter", "dragover"]) this.drop.addEventListener(name, (event) => this.over(event, true));
    for (const name of ["dragleave", "drop"]) this.drop.addEventListener(name, (event) => this.over(event, false));
    this.drop.addEventListener("drop", (event) => this.take(event.dataTransfer.files[0]));
    this.boards = h("p", {});
    this.select = button("Select boards", { onclick: select }, "list");
    this.older = h("input", { type: "checkbox" });
    this.parallel = h("input", { type: "number", min: "1", max: "24", value: "4", class: "narrow" });
    this.ask = button("Show the plan", { onclick: () => this.ask.busy(() => this.asked()) }, "list");
    this.blocked = h("p", { class: "hint" });
    this.result = h("div", { class: "plan" });
    this.form = h("div", { class: "stack" }, this.boards, this.select, h("div", {}, this.file, this.drop), h("div", { class: "row" }, field("Boards at once", this.parallel), h("label", { class: "check" }, this.older, " Allow an older version"), this.ask), this.blocked, this.result);
    this.head = h("h3", { tabindex: "-1" });
    this.facts = h("p", {});
    this.totals = h("p", { class: "lead" });
    this.rows = h("ul", { class: "lines", "aria-label": "Boards of this update" });
    this.cancel = button("Begin no further board", { onclick: () => this.cancel.busy(() => this.stop()) }, "stop");
    this.trouble = h("div", {});
    this.running = h("section", { class: "panel", "aria-label": "How the update goes", hidden: true }, this.head, this.facts, this.totals, this.rows, h("div", { class: "row" }, this.cancel), this.trouble);
    fill(
      parent,
      h("a", { class: "back", href: "#/nodes" }, "All nodes"),
      h("h2", {}, "Firmware update"),
      this.running,
      (this.asking = h("section", { class: "panel", "aria-label": "New update" }, h("h3", {}, "New update"), h("p", { class: "hint" }, "You will see what happens to each board before anything changes. A board keeps the new image only if it proves itself; else its old firmware runs again."), this.form)),
    );
    this.off = on("nodes status connection updates update", () => this.paint());
    refresh("updates");
    this.paint();
  }

  over(event, yes) {
    event.preventDefault();
    this.drop.classList.toggle("over", yes);
  }

  paint() {
    const busy = state.updates.some((one) => one.state === "running");
    this.asking.hidden = busy;
    const uuids = this.chosen();
    text(this.boards, uuids.length ? `${count(uuids.length, "board")} selected: ${uuids.slice(0, 8).map(called).join(", ")}${uuids.length > 8 ? ` and ${uuids.length - 8} more` : ""}` : "No boards are selected.");
    this.select.hidden = uuids.length > 0;
    const blocked = state.status?.write === false ? "This browser has read-only access." : "";
    text(this.blocked, blocked);
    const off = Boolean(blocked) || state.connection !== "live";
    this.file.disabled = off;
    this.drop.classList.toggle("off", off);
    if (this.ask.getAttribute("aria-busy") !== "true") this.ask.disabled = off || !this.image || !uuids.length;
    if (this.go && this.go.getAttribute("aria-busy") !== "true") this.go.disabled = off || !this.meant().length;
    this.follow(latest(), off);
  }

  async take(file) {
    this.file.value = "";
    if (!file || this.file.disabled) return;
    this.clear();
    this.image = null;
    if (file.size > LARGEST) fill(this.result, trouble({ message: `${file.name} is too large for a firmware image (${file.size} bytes).`, hint: "Choose the signed image of one board, at most 4 MiB." }));
    else {
      try {
        this.image = { name: file.name, octets: await file.arrayBuffer() };
      } catch {
        fill(this.result, trouble({ message: `${file.name} cannot be read.`, hint: "Choose a file, not a folder." }));
      }
    }
    text(this.fileName, this.image ? `${this.image.name}, ${Math.ceil(this.image.octets.byteLength / 1024)} KiB` : "Choose a firmware image");
    this.paint();
  }

  query(nodes, more = {}) {
    const words = { nodes: nodes.join(","), parallel: this.parallel.value || "1", ...(this.older.checked && { allow_downgrade: "1" }), ...more };
    return `updates?${new URLSearchParams(words)}`;
  }

  async asked() {
    this.clear();
    fill(this.result, h("p", { class: "busy-line" }, "Asking each board …"));
    try {
      const plan = await send(this.query(this.chosen(), { dry_run: "1" }), this.image.octets, { signal: this.leaving.signal, patience: PATIENCE });
      this.show(plan);
    } catch (error) {
      if (error.name !== "AbortError") fill(this.result, trouble(error));
    }
  }

  /** Boards of the plan to update: those without a question, and those whose question was answered with yes. */
  meant() {
    return (this.plan?.boards ?? []).filter((one) => one.plan && !one.result && (!one.question || this.yes.get(one.uuid).checked)).map((one) => one.uuid);
  }

  show(plan) {
    this.plan = plan;
    this.yes = new Map(plan.boards.filter((one) => one.question).map((one) => [one.uuid, h("input", { type: "checkbox", onchange: () => this.counted() })]));
    this.go = button("", { class: "main" }, "good");
    this.go.addEventListener("click", () => this.go.busy(() => this.begin()));
    const image = plan.image;
    fill(
      this.result,
      h("h4", { tabindex: "-1" }, `Plan: version ${image.version}`),
      h("p", { class: "hint" }, `For ${image.board ?? "a board that it does not name"}. Image ${image.digest.slice(0, 16)}, ${image.octets} octets.`),
      h("ul", { class: "lines", "aria-label": "Plan of each board" }, plan.boards.map((one) => this.planned(one))),
      h("div", { class: "row" }, this.go, button("Cancel", { onclick: () => (this.clear(), this.paint()) })),
    );
    this.counted();
    this.result.querySelector("h4").focus({ preventScroll: true });
    const refused = plan.boards.filter((one) => one.error).length;
    say(`Plan for ${count(plan.boards.length, "board")}${refused ? `, ${refused} refused` : ""}${this.yes.size ? `, ${this.yes.size} with a question` : ""}.`);
  }

  planned(one) {
    const name = called(one.uuid);
    const told = [h("strong", {}, name), h("span", { class: "hint" }, ` ${one.from ?? "unknown"} → ${one.to}`)];
    if (one.error) return h("li", {}, h("span", { class: "grow" }, told), chip(...RESULTS[one.result]), h("p", { class: "hint full" }, one.error.message, " ", one.error.code === "downgrade" ? "To go back on purpose, tick “Allow an older version” and show the plan again." : one.error.hint));
    const what = `${PLANS[one.plan]} ${one.to}${one.octets ? `, ${one.octets} octets, about ${Math.max(1, Math.round(one.seconds))} s` : ""}.${one.interrupts.length ? " Its measurement pauses." : ""}`;
    const box = this.yes.get(one.uuid);
    return h(
      "li",
      {},
      h("span", { class: "grow" }, told),
      one.question ? chip("warn", "ask", "question") : chip(one.result ? "plain" : "good", "good", one.result ? "nothing to do" : "ready"),
      h("p", { class: "hint full" }, what),
      box ? h("label", { class: "check full" }, box, ` ${one.question} Install it on ${name} all the same`) : null,
    );
  }

  counted() {
    const many = this.meant().length;
    text(this.go.lastChild, many ? `Update ${count(many, "board")} to ${this.plan.image.version}` : "No board to update");
    this.paint();
  }

  async begin() {
    const nodes = this.meant();
    const other = nodes.filter((uuid) => this.yes.has(uuid));
    try {
      const update = await send(this.query(nodes, other.length ? { other_board: other.join(",") } : {}), this.image.octets, { patience: PATIENCE });
      this.clear();
      say(`Updating ${count(nodes.length, "board")}.`);
      await refresh("updates");
      this.paint();
      if (latest()?.id === update.id) this.head.focus({ preventScroll: true });
    } catch (error) {
      this.result.append(trouble(error));
      refresh("updates");
    }
  }

  async stop() {
    this.trouble.replaceChildren();
    try {
      await remove(paths.update(latest().id));
      await refresh("updates");
    } catch (error) {
      fill(this.trouble, trouble(error));
    }
  }

  follow(update, off) {
    this.running.hidden = !update;
    if (!update) return;
    const running = update.state === "running";
    text(this.head, running ? `Updating to ${update.image.version}` : update.state === "stopped" ? `Update to ${update.image.version} was stopped` : `Update to ${update.image.version} is over`);
    const since = `Requested by ${update.owner === "page" ? "the page" : update.owner} at ${clock(update.began)}`;
    text(this.facts, running ? `${since}. It goes on if this page is closed.` : `${since}, over at ${clock(update.ended)}.`);
    const counted = Object.keys(RESULTS).filter((name) => update.boards.some((one) => one.result === name)).map((name) => `${update.boards.filter((one) => one.result === name).length} ${RESULTS[name][2]}`);
    const told = `${progressOf(update)}${counted.length ? `: ${counted.join(", ")}` : ""}`;
    if (this.totals.textContent !== told && this.totals.textContent) say(told);
    text(this.totals, told);
    this.cancel.hidden = !running || !update.boards.some((one) => one.state === "waiting");
    if (this.cancel.getAttribute("aria-busy") !== "true") this.cancel.disabled = off;
    keyed(this.rows, update.boards, (one) => one.uuid, () => h("li", {}), (element, one) => this.row(element, one));
  }

  row(element, one) {
    const share = one.step === "upload" && one.octets ? Math.floor((100 * one.written) / one.octets) : null;
    const name = called(one.uuid);
    const told = JSON.stringify([name, one.state, one.step, one.result, one.error, one.from]);
    if (element.told !== told) {
      element.told = told;
      const [tone, sign, words] = RESULTS[one.result] ?? { waiting: ["plain", "clock", "waiting"], skipped: ["plain", "clock", "not begun"] }[one.state] ?? ["busy", "clock", STEPS[one.step] ?? "looking"];
      element.bar = share === null ? null : h("progress", { max: "100", "aria-label": `Upload to ${name}` });
      fill(
        element,
        h("span", { class: "grow" }, h("a", { href: `#/nodes/${one.uuid}` }, name), h("span", { class: "hint" }, ` ${one.from ?? "unknown"} → ${one.to}${one.result ? `, ${short(one.seconds)} s` : ""}`)),
        chip(tone, sign, words),
        element.bar,
        one.error ? h("p", { class: "hint full" }, `${one.error.message} ${one.error.hint}`) : null,
      );
    }
    if (element.bar) element.bar.value = share;
  }

  clear() {
    this.go = this.plan = null;
    this.result.replaceChildren();
  }

  end() {
    this.leaving.abort();
    this.off();
  }
}

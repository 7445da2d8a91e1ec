// The provisioning tab: from a type to a signed datasheet; waits for the tap and shows progress live.

import { get, paths, post } from "../api.js";
import { button, chip, field, fill, h, icon, keyed, say, text, trouble } from "../dom.js";
import { clock, short } from "../format.js";
import { frozenBy, now, on, state } from "../state.js";

const STEPS = {
  identify: "Identify",
  whitelist: "Add to the whitelist",
  agree: "Agree on a key",
  build: "Build the datasheet",
  sign: "Sign",
  write: "Write",
  verify: "Read back and verify",
};
const RESULTS = { done: ["good", "good", "done"], skipped: ["plain", "good", "not needed"], running: ["busy", "clock", "in progress"], failed: ["bad", "bad", "failed"] };

export class ProvisionTab {
  constructor(parent, uuid) {
    this.uuid = uuid;
    this.profile = h("select", {});
    this.name = h("input", { type: "text", maxlength: "120", autocomplete: "off" });
    this.calibration = h("input", { type: "file", accept: ".csv,.toml,.json,.txt,.xml", onchange: () => this.paint() });
    this.item = h("input", { type: "text", maxlength: "120", autocomplete: "off", placeholder: "only if several fit" });
    this.choice = field("Result of the certificate", this.item);
    this.go = button("Provision", { class: "main", onclick: () => this.go.busy(() => this.start()).then(() => this.paint()) }, "good");
    this.cancel = button("Cancel", { onclick: () => this.cancel.busy(() => this.end_waiting()) });
    this.waiting = h("div", { class: "waiting", role: "status" });
    this.clock = h("span", { class: "figure", "aria-hidden": "true" });
    this.steps = h("ol", { class: "steps" });
    this.outcome = h("div", {});
    this.why = h("p", { class: "hint" });
    const node = state.nodes.get(uuid);
    this.name.value = node?.name ?? "";
    parent.append(
      h(
        "section",
        { class: "panel", "aria-label": "Provision" },
        h(uuid === "next" ? "h2" : "h3", {}, uuid === "next" ? "Provision the next tapped node" : "Provision"),
        h("p", { class: "hint" }, "Agrees on a key with the node and writes a signed datasheet. If a tap is needed, place the node on the reader when asked."),
        h("div", { class: "row" }, field("Transducer type", this.profile), field("Name", this.name), field("Calibration file or certificate (optional)", this.calibration), this.choice),
        h("div", { class: "row" }, this.go, this.why),
        this.waiting,
        this.steps,
        this.outcome,
      ),
    );
    this.off = on("profiles nodes status connection measurements provision", () => this.paint());
    this.ticking = setInterval(() => this.tick(), 250);
    this.paint();
    this.recall();
  }

  /** Show a run that was started before this page was opened, here or in another browser. */
  async recall() {
    if (this.run) return;
    const run = await get(paths.provision(this.uuid)).catch(() => null); // no run: nothing to show
    if (!run || this.run || !["waiting", "running"].includes(run.state)) return;
    state.runs.set(this.uuid, run);
    this.paint();
  }

  get run() {
    return state.runs.get(this.uuid) ?? null;
  }

  paint() {
    const node = state.nodes.get(this.uuid);
    const chosen = this.profile.value || node?.profile || "";
    const many = state.profiles.map((one) => one.name).join("\n");
    if (this.profile.told !== many) {
      this.profile.told = many;
      fill(this.profile, h("option", { value: "" }, "Choose a type"), state.profiles.map((one) => h("option", { value: one.name }, one.title || one.name)));
      this.profile.value = chosen;
    }
    this.choice.hidden = !this.certified();
    const run = this.run;
    const busy = run?.state === "waiting" || run?.state === "running";
    const blocked = frozenBy(this.uuid) || (state.status?.write === false ? "This browser has read-only access." : "");
    text(this.why, blocked);
    if (this.go.getAttribute("aria-busy") !== "true") this.go.disabled = busy || Boolean(blocked) || state.connection !== "live";
    this.follow(run);
  }

  follow(run) {
    const waits = run?.state === "waiting";
    if (waits && !this.waiting.firstChild) {
      const words = this.uuid === "next" ? "Place a node on the reader." : "Place this node on the reader.";
      fill(this.waiting, icon("nfc"), h("div", {}, h("p", { class: "lead" }, words), h("p", {}, "Waiting for a tap until ", clock(run.until), " ", this.clock)), this.cancel);
      say(words);
    } else if (!waits && this.waiting.firstChild) this.waiting.replaceChildren();
    keyed(this.steps, run?.steps ?? [], (step) => step.name, () => h("li", {}), (element, step) => {
      const [tone, sign, words] = RESULTS[step.result] ?? ["plain", "good", step.result];
      if (element.told === step.result) return;
      element.told = step.result;
      fill(element, chip(tone, sign, words), h("span", {}, STEPS[step.name] ?? step.name), step.detail ? h("span", { class: "hint" }, step.detail) : null);
    });
    if (this.shown === run) return;
    this.shown = run;
    if (run?.state === "done") {
      fill(this.outcome, h("p", { class: "done" }, chip("good", "good", "Provisioned"), " This node is ready. ", h("a", { href: `#/nodes/${this.uuid}/live` }, "See its values")));
      say("Provisioned.");
    } else if (run?.state === "cancelled") fill(this.outcome, h("p", { class: "hint" }, "Provisioning was cancelled."));
    else if (run?.state === "failed") fill(this.outcome, trouble(run.error ?? { message: "Provisioning failed." }));
    else this.outcome.replaceChildren();
  }

  tick() {
    const run = this.run;
    if (run?.state !== "waiting" || !run.until) return;
    text(this.clock, `(${short(Math.max(0, Math.ceil(run.until - now())))} s)`);
  }

  /** True if the chosen file is a calibration certificate. */
  certified() {
    return this.calibration.files[0]?.name.toLowerCase().endsWith(".xml") ?? false;
  }

  async start() {
    this.outcome.replaceChildren();
    if (!this.profile.value) {
      fill(this.outcome, trouble({ message: "Choose a transducer type.", hint: "The list shows the profiles of this station." }));
      this.profile.focus();
      return;
    }
    const file = this.calibration.files[0];
    const before = this.run;
    try {
      const answer = await post(paths.provision(this.uuid), {
        profile: this.profile.value,
        name: this.name.value.trim() || null,
        calibration: file ? await file.text() : null,
        calibration_name: file?.name ?? null,
        calibration_item: this.certified() ? this.item.value.trim() || null : null,
      });
      // An event, even that of the end, may have arrived before this answer; then it is more recent.
      if (this.run === before) state.runs.set(this.uuid, { steps: [], ...answer, state: answer.state ?? (answer.waits_for ? "waiting" : "running") });
      this.paint();
    } catch (error) {
      fill(this.outcome, trouble(error));
    }
  }

  async end_waiting() {
    try {
      const run = await post(paths.provision(this.uuid), { cancel: true });
      state.runs.set(this.uuid, run);
      this.paint();
    } catch (error) {
      fill(this.outcome, trouble(error));
    }
  }

  end() {
    this.off();
    clearInterval(this.ticking);
  }
}

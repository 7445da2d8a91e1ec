// Offers the rate that the station proposes, before a measurement and while one loses values.

import { get } from "../api.js";
import { button, h, text } from "../dom.js";
import { hertz } from "../format.js";
import { state } from "../state.js";

const EVERY = 30000; // ms between two requests: the machine's load changes

/** A line below the rate field. `of()`: the query for the measured nodes; `take(rate)` starts again at a lower rate. */
export class RateHint {
  constructor(entry, of, take) {
    Object.assign(this, { entry, of, take, rate: null, losing: false, asked: -Infinity });
    this.words = h("span", { class: "hint" });
    this.use = button("", { onclick: () => this.use.busy(() => this.apply()) });
    this.element = h("div", { class: "row rate-hint", hidden: true }, this.words, this.use);
  }

  /** `one`: the running measurement, or null. */
  paint(one, may) {
    this.use.disabled = !may || this.use.getAttribute("aria-busy") === "true";
    if (one) return this.running(one);
    if (this.losing) this.hide();
    if (state.connection === "live" && performance.now() - this.asked > EVERY) this.ask();
  }

  running(one) {
    this.asked = -Infinity;
    const rate = one.lower_rate;
    if (typeof rate !== "number" || one.owner === "command") return this.hide();
    const first = !this.losing;
    this.losing = true;
    if (first || rate < this.rate) this.show(rate, "Values are being lost at this rate.", `Measure at ${hertz(rate)}`);
  }

  async ask() {
    this.asked = performance.now();
    const found = await get(`measurements/rate?${this.of()}`).catch(() => null); // nothing is shown without a proposal
    if (this.losing || !found) return;
    const proposal = found.proposal;
    if (!proposal || proposal.limit === "datasheet") return this.hide();
    this.show(proposal.rate, `Values may be lost at the datasheet's ${hertz(proposal.stated)}: ${proposal.why}.`, `Use ${hertz(proposal.rate)}`);
  }

  show(rate, words, act) {
    this.rate = rate;
    this.element.hidden = false;
    text(this.words, words);
    text(this.use.lastChild, act);
  }

  hide() {
    this.losing = false;
    this.rate = null;
    this.element.hidden = true;
  }

  async apply() {
    const rate = this.rate;
    this.entry.value = String(rate);
    if (this.losing) await this.take();
    this.hide();
    this.entry.focus();
  }
}

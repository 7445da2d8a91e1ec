// Choose if ROS topics may send set points to the measured nodes, and the dead-man of their actuators.

import { Refusal } from "../api.js";
import { field, h, text } from "../dom.js";
import { state } from "../state.js";

const LEAST = 20; // ms, the least that a node accepts
const MOST = 10000;

export class SetPoints {
  constructor() {
    this.box = h("input", { type: "checkbox", checked: true });
    this.deadMan = h("input", { type: "number", min: LEAST, max: MOST, step: "1", inputmode: "numeric", class: "narrow" });
    this.hint = h("span", { class: "hint" });
    this.element = h("div", { class: "row", role: "group", "aria-label": "Set points from topics" }, h("label", { class: "tick" }, this.box, h("span", {}, "Allow topics to move actuators")), field("Dead-man, ms", this.deadMan), this.hint);
  }

  /** `one`: the running measurement, or null; `uuids`: the nodes concerned. */
  paint(uuids, one) {
    const movable = uuids.some((uuid) => (state.nodes.get(uuid)?.channels ?? []).some((channel) => channel.kind === "actuator"));
    const taken = state.status?.actuators === true;
    this.element.hidden = !movable;
    this.box.disabled = this.deadMan.disabled = Boolean(one) || !taken;
    if (one && taken) this.box.checked = one.actuators;
    this.deadMan.placeholder = `${one?.dead_man ?? state.status?.dead_man ?? ""}`;
    text(this.hint, !taken ? "This station does not accept set points from topics." : one ? (one.actuators ? `Accepted. An actuator goes to its safe state ${one.dead_man} ms after the last one.` : "Not accepted in this measurement.") : "");
  }

  /** Members for POST /measurements; throws if the dead-man is not valid. */
  get asked() {
    const words = this.deadMan.value.trim();
    const deadMan = words === "" ? null : Number(words);
    if (!this.deadMan.validity.valid || (deadMan !== null && (!Number.isInteger(deadMan) || deadMan < LEAST || deadMan > MOST))) {
      throw new Refusal(0, "usage", `The dead-man must be between ${LEAST} and ${MOST} ms.`, `Leave it empty to use the station's default of ${state.status?.dead_man} ms.`);
    }
    return { actuators: this.box.checked, ...(deadMan === null ? {} : { dead_man: deadMan }) };
  }
}

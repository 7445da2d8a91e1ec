// Whether set points may come by topics of ROS for what is measured, and when an actuator without them is safe.

import { Refusal } from "../api.js";
import { field, h, text } from "../dom.js";
import { state } from "../state.js";

const LEAST = 20; // ms, as the node takes it
const MOST = 10000;

export class SetPoints {
  constructor() {
    this.box = h("input", { type: "checkbox", checked: true });
    this.deadMan = h("input", { type: "number", min: LEAST, max: MOST, step: "1", inputmode: "numeric", class: "narrow" });
    this.hint = h("span", { class: "hint" });
    this.element = h("div", { class: "row", role: "group", "aria-label": "Set points from topics" }, h("label", { class: "tick" }, this.box, h("span", {}, "Allow topics to move actuators")), field("Dead-man, ms", this.deadMan), this.hint);
  }

  /** `one`: the measurement that runs, null where none does; `uuids`: the nodes that it is about. */
  paint(uuids, one) {
    const movable = uuids.some((uuid) => (state.nodes.get(uuid)?.channels ?? []).some((channel) => channel.kind === "actuator"));
    const taken = state.status?.actuators === true;
    this.element.hidden = !movable;
    this.box.disabled = this.deadMan.disabled = Boolean(one) || !taken;
    if (one && taken) this.box.checked = one.actuators;
    this.deadMan.placeholder = `${one?.dead_man ?? state.status?.dead_man ?? ""}`;
    text(this.hint, !taken ? "This station does not accept set points from topics." : one ? (one.actuators ? `Accepted. An actuator goes to its safe state ${one.dead_man} ms after the last one.` : "Not accepted in this measurement.") : "");
  }

  /** What POST /measurements is told; throws where the dead-man is none. */
  get asked() {
    const words = this.deadMan.value.trim();
    const deadMan = words === "" ? null : Number(words);
    if (!this.deadMan.validity.valid || (deadMan !== null && (!Number.isInteger(deadMan) || deadMan < LEAST || deadMan > MOST))) {
      throw new Refusal(0, "usage", `The dead-man must be between ${LEAST} and ${MOST} ms.`, `Leave it empty to use the station's default of ${state.status?.dead_man} ms.`);
    }
    return { actuators: this.box.checked, ...(deadMan === null ? {} : { dead_man: deadMan }) };
  }
}

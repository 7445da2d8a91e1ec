// An actuator: it moves only while a button is held, and goes to its safe state at release.

import { change, paths } from "../api.js";
import { chip, field, fill, h, icon, say, text, trouble } from "../dom.js";
import { channelName, clock, nameOf, range, reading, within } from "../format.js";
import { toShown, toSi } from "../shapes.js";
import { now, on, state } from "../state.js";

const HOLD = 0.8; // s: without a request for so long, the station releases the actuator
const AGAIN = 250; // ms between two requests while the button is held

export class ActuatorPanel {
  constructor(uuid, number_) {
    this.uuid = uuid;
    this.number = number_;
    this.holding = false;
    this.sending = false;
    this.safeAt = null;
    this.error = h("div", {});
    this.state = h("p", { class: "actuator-state", role: "status" });
    this.slider = h("input", { type: "range", oninput: () => this.typed(this.slider, this.entry) });
    this.entry = h("input", { type: "number", step: "any", class: "narrow", oninput: () => this.typed(this.entry, this.slider) });
    this.words = h("span", {}, "Hold to move");
    this.button = h("button", { type: "button", class: "hold" }, icon("play"), this.words);
    this.listen();
    const channel = this.channel;
    const name = channelName(channel);
    this.limits = h("p", { class: "hint" });
    this.sliderField = field("Set point", this.slider);
    this.element = h(
      "section",
      { class: "panel actuator", "aria-label": `Actuator ${name}` },
      h("div", { class: "panel-head" }, h("h3", {}, name), chip("plain", "play", "Actuator"), this.state),
      h("div", { class: "row" }, this.sliderField, field(`Value${channel.unit ? `, ${channel.unit}` : ""}`, this.entry), this.button),
      this.limits,
      this.error,
    );
    this.off = on("nodes status connection actuator", () => this.paint());
    this.setup(channel);
    this.paint();
  }

  get channel() {
    return state.nodes.get(this.uuid)?.channels?.find((one) => one.number === this.number) ?? { number: this.number, kind: "actuator" };
  }

  setup(channel) {
    const bounded = typeof channel.low === "number" && typeof channel.high === "number" && channel.high > channel.low;
    this.sliderField.hidden = !bounded;
    if (bounded) {
      for (const control of [this.slider, this.entry]) {
        control.min = channel.low;
        control.max = channel.high;
      }
      this.slider.step = (channel.high - channel.low) / 1000;
      this.slider.value = channel.low;
    }
    this.entry.value = typeof channel.low === "number" ? within(channel.low, channel.low, channel.high) : "0";
  }

  typed(from, to) {
    to.value = from.value === "" ? to.value : from.value;
    if (from === this.slider) this.entry.value = within(Number(from.value), this.channel.low, this.channel.high);
  }

  listen() {
    const end = () => this.release();
    this.button.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      event.preventDefault();
      this.button.focus();
      this.button.setPointerCapture(event.pointerId);
      this.hold();
    });
    for (const name of ["pointerup", "pointercancel", "lostpointercapture", "blur", "contextmenu"]) this.button.addEventListener(name, end);
    this.button.addEventListener("keydown", (event) => {
      if (event.key !== " " && event.key !== "Enter") return;
      event.preventDefault();
      if (!event.repeat) this.hold();
    });
    this.button.addEventListener("keyup", (event) => (event.key === " " || event.key === "Enter") && this.release());
    this.gone = () => this.release(true);
    document.addEventListener("visibilitychange", this.gone);
    window.addEventListener("pagehide", this.gone);
    window.addEventListener("blur", this.gone);
  }

  hold() {
    if (this.holding || this.button.disabled) return;
    const value = Number(this.entry.value);
    if (this.entry.value === "" || !Number.isFinite(value)) {
      fill(this.error, trouble({ message: "Enter a number as the set point.", hint: `It must be within ${range(this.channel)}.` }));
      return;
    }
    this.error.replaceChildren();
    this.holding = true;
    this.safeAt = null;
    this.button.dataset.held = "";
    this.button.setAttribute("aria-pressed", "true");
    text(this.words, "Moving: release to stop");
    say(`Moving ${channelName(this.channel)}.`);
    this.paint();
    this.feed();
  }

  /** Send requests one after the other, never two at once: the last one received is the latest. */
  async feed() {
    if (this.sending) return;
    this.sending = true;
    let refused = null;
    while (this.holding && !refused) {
      const began = performance.now();
      try {
        const done = await change(paths.channel(this.uuid, this.number), { value: toSi(this.channel.scale, Number(this.entry.value)), hold: HOLD });
        this.applied = done.applied ? toShown(this.channel.scale, done.applied.value) : null;
        this.paint();
      } catch (error) {
        refused = error;
      }
      if (this.holding && !refused) await this.pause(AGAIN - (performance.now() - began));
    }
    this.sending = false;
    if (refused) {
      this.letGo();
      fill(this.error, trouble(refused));
    }
    await this.safe(refused);
  }

  /** Wait, but only while the button is held. */
  pause(milliseconds) {
    return new Promise((go) => {
      this.wake = go;
      setTimeout(go, Math.max(0, milliseconds));
    });
  }

  release(leaving = false) {
    if (!this.holding || (leaving && document.visibilityState === "visible" && document.hasFocus())) return;
    this.letGo();
    if (leaving === true) this.word(true).catch(() => {}); // the page may close before the loop runs again
  }

  letGo() {
    this.holding = false;
    delete this.button.dataset.held;
    this.button.setAttribute("aria-pressed", "false");
    text(this.words, "Hold to move");
    this.stopping = true;
    this.wake?.();
    this.paint();
  }

  word(keepalive = false) {
    return change(paths.channel(this.uuid, this.number), { hold: 0 }, { keepalive });
  }

  async safe(refused) {
    try {
      const done = await this.word();
      this.stopping = false;
      if (done.safe === true) {
        this.safeAt = now();
        say(`${channelName(this.channel)} of ${nameOf(state.nodes.get(this.uuid))} is in its safe state.`);
      }
    } catch (error) {
      this.stopping = false;
      if (!refused) fill(this.error, trouble({ message: error.message, hint: `${error.hint ? `${error.hint} ` : ""}Without further set points, the node goes to its safe state by itself within a second.` }));
    }
    this.paint();
  }

  paint() {
    const channel = this.channel;
    const told = channel.actuator;
    const may = state.connection === "live" && state.status?.write !== false && state.nodes.get(this.uuid)?.whitelisted !== false;
    if (!may && this.holding) this.letGo();
    this.button.disabled = !may;
    text(this.limits, `Limits ${range(channel)}. It moves only while you hold the button (or Space). Release it, and the node returns to its safe state. This is not a safety function: keep an emergency stop within reach.`);
    const figure = (value) => `${reading(value, channel, null)}${channel.unit ? ` ${channel.unit}` : ""}`;
    let shown;
    if (this.holding) shown = chip("busy", "play", `Moving: ${figure(this.applied ?? Number(this.entry.value))}`);
    else if (this.stopping) shown = chip("warn", "clock", "Stopping …");
    else if (told?.safe === false) shown = chip("busy", "play", `Controlled from elsewhere: ${figure(told.value)}`);
    else if (this.safeAt) shown = chip("good", "good", `Safe: confirmed by the node at ${clock(this.safeAt)}`);
    else if (told?.safe === true) shown = chip("good", "good", "Safe state");
    else shown = chip("plain", "ask", "Not controlled from this page");
    if (this.state.textContent !== shown.textContent) fill(this.state, shown);
  }

  end() {
    this.off();
    if (this.holding) {
      this.letGo();
      this.word(true).catch(() => {});
    }
    document.removeEventListener("visibilitychange", this.gone);
    window.removeEventListener("pagehide", this.gone);
    window.removeEventListener("blur", this.gone);
  }
}

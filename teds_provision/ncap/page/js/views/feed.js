// A virtual transducer fed by a simulation: the program that feeds it, its state, and sliders to feed it from here.

import { sourceAddress } from "../api.js";
import { button, chip, field, fill, h, keyed, say, text, trouble } from "../dom.js";
import { clock, count, short, within } from "../format.js";
import { state } from "../state.js";

const EVERY = 50; // ms between two lines while a slider moves

export class Feed {
  constructor(uuid) {
    this.uuid = uuid;
    this.socket = null;
    this.ready = false; // the station has accepted the connection
    this.values = {}; // by channel name; null: no value
    this.sent = 0; // when the last line was sent
    this.planned = null;
    this.who = h("p", { class: "feed-state", role: "status" });
    this.go = button("Set values here", { onclick: () => (this.socket ? this.stop() : this.start()) }, "play");
    this.sliders = h("div", { class: "stack feed-channels" });
    this.news = h("p", { class: "warn-line" });
    this.error = h("div", {});
    this.element = h(
      "div",
      { class: "feed", role: "group" },
      this.who,
      h("div", { class: "row" }, this.go),
      this.sliders,
      this.news,
      this.error,
      h("details", { class: "more" }, h("summary", {}, "From a program"), h("p", {}, "Send lines to this WebSocket, with a token that may write:"), h("p", {}, h("code", {}, sourceAddress(uuid).href)), h("p", {}, "Each line is a JSON object, such as ", h("code", {}, '{"value": {"NAME": 1.5}}'), ".")),
    );
  }

  paint(one, may) {
    const fed = one.simulation;
    const mine = this.socket !== null;
    this.element.setAttribute("aria-label", `Values of ${one.name || one.uuid}`);
    const words = this.ready ? "Values are set on this page." : mine ? "Connecting …" : fed ? `Fed by ${fed.by === "page" ? "another page" : fed.by.replace(/^api:/, "token ")} since ${clock(fed.since)}.` : "Nothing feeds it: its values are not valid.";
    const good = this.ready || (fed && !mine);
    if (this.who.textContent !== words) fill(this.who, chip(good ? "good" : "warn", good ? "good" : "warn", words));
    text(this.go.lastChild, mine ? "Stop" : "Set values here");
    this.go.setAttribute("aria-label", `${mine ? "Stop setting" : "Set"} values of ${one.name || one.uuid}`);
    this.go.disabled = !may || (!mine && Boolean(fed));
    if (state.connection !== "live" && mine) this.lost("The connection to the station is lost: the values are no longer valid.");
  }

  start() {
    this.error.replaceChildren();
    text(this.news, "");
    const socket = (this.socket = new WebSocket(sourceAddress(this.uuid)));
    socket.onmessage = (message) => {
      if (socket !== this.socket) return;
      const told = JSON.parse(message.data);
      if (told.ready) {
        this.ready = true;
        this.open(told.channels);
        this.changed();
      }
      if (told.skipped || told.limited) text(this.news, `${count(told.skipped ?? told.limited, "value")} not taken as set: ${told.why}.`);
      if (told.set) text(this.news, Object.entries(told.set).map(([name, value]) => `${name} is set to ${short(value)}`).join(", "));
    };
    socket.onclose = (event) => {
      if (socket !== this.socket) return;
      this.lost(this.ready ? event.reason || "The station closed the connection: the values are no longer valid." : "The station refused the connection. Another simulation may feed this transducer, or it is still starting.");
    };
    this.changed();
  }

  open(channels) {
    this.values = {};
    keyed(this.sliders, channels.filter((one) => one.name), (one) => `${this.uuid}/${one.number}`, (one) => this.slider(one));
    this.send();
    say("Values are set on this page.");
    this.sliders.querySelector("input")?.focus();
  }

  slider(channel) {
    const bounded = typeof channel.low === "number" && typeof channel.high === "number";
    const unit = channel.unit ? `, ${channel.unit}` : "";
    const first = bounded ? channel.low + (channel.high - channel.low) / 2 : 0;
    const entry = h("input", { type: "number", step: "any", class: "narrow", value: Number(first.toPrecision(4)) });
    const range = bounded ? h("input", { type: "range", min: channel.low, max: channel.high, step: (channel.high - channel.low) / 1000, "aria-label": `${channel.name}${unit}` }) : null;
    if (range) range.value = first;
    const none = h("input", { type: "checkbox" });
    const take = () => {
      this.values[channel.name] = none.checked || entry.value === "" ? null : Number(entry.value);
      this.send();
    };
    entry.addEventListener("input", () => {
      if (range) range.value = entry.value;
      take();
    });
    range?.addEventListener("input", () => {
      entry.value = within(Number(range.value), channel.low, channel.high);
      take();
    });
    none.addEventListener("change", take);
    this.values[channel.name] = first;
    return h("div", { class: "row" }, field(`${channel.name}${unit}`, entry), range, h("label", { class: "tick" }, none, h("span", {}, "no value")));
  }

  /** Send the values, at most once in EVERY; the last ones always. */
  send() {
    if (this.socket?.readyState !== WebSocket.OPEN) return;
    const wait = this.sent + EVERY - performance.now();
    if (wait > 0) {
      this.planned ??= setTimeout(() => {
        this.planned = null;
        this.send();
      }, wait);
      return;
    }
    this.sent = performance.now();
    this.socket.send(JSON.stringify({ value: this.values }));
  }

  stop() {
    const socket = this.socket;
    this.socket = null;
    this.ready = false;
    clearTimeout(this.planned);
    this.planned = null;
    if (socket) {
      socket.onmessage = socket.onclose = null;
      socket.close();
    }
    keyed(this.sliders, [], () => "");
    text(this.news, "");
    this.changed();
  }

  lost(words) {
    this.stop();
    fill(this.error, trouble({ message: words, hint: "Press Set values here to try again." }));
  }

  /** Called at the beginning and the end; the view overrides it. */
  changed() {}

  end() {
    this.changed = () => {};
    this.stop();
  }
}

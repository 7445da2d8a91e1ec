// Facts about a node that several views show: its link, its state, its power, one line of its security check.

import { chip, h, icon } from "../dom.js";
import { age, grouped } from "../format.js";
import { now } from "../state.js";

const LINKS = { nfc: "NFC", can: "CAN", ble: "BLE", virtual: "Virtual" };

const RESULTS = { passed: ["good", "good", "passed"], failed: ["bad", "bad", "failed"], skipped: ["plain", "ask", "skipped"] };

/** Display name of a link. */
export const linkName = (link) => LINKS[link] ?? link ?? "no link";

/** Link, state and battery as words with icons. */
export function facts(node) {
  const out = [h("span", {}, icon(node.virtual ? "virtual" : (node.link ?? "ask")), node.virtual ? "Virtual" : linkName(node.link))];
  if (node.present === false) out.push(h("span", { class: "warn" }, icon("clock"), node.seen ? `away, seen ${age(now() - node.seen)}` : "away"));
  else if (node.busy) out.push(h("span", { class: "busy" }, icon("clock"), node.busy));
  else if (node.mode === "measuring") out.push(h("span", { class: "busy" }, icon("wave"), "measuring"));
  else if (node.mode) out.push(h("span", { class: "warn" }, icon("clock"), node.mode));
  else if (node.state) out.push(h("span", {}, node.state));
  if (node.wrapped) out.push(h("span", { class: "warn", title: "The proof ends at the wrapper, not at the sensor." }, icon("warn"), `wrapped: ${node.wrapped.name} (${node.wrapped.kind})`));
  if (node.firmware) out.push(firmware(node.firmware));
  if (node.whitelisted === false) out.push(h("span", { class: "warn" }, icon("warn"), "not on the whitelist"));
  if (node.groups?.length) out.push(h("span", {}, icon("list"), node.groups.join(", ")));
  if (node.power) out.push(power(node.power));
  return out;
}

const FIRMWARE = { bad: "ruled out by its type", other: "not of its type", outdated: "outdated", "on-trial": "on trial", pending: "another starts at the next restart" };

/** Firmware, and if it meets the demands of its type. Treated as hostile text, like everything that a node sends. */
function firmware(told) {
  const build = told.build ? `+${told.build}` : "";
  const name = told.version === null ? "firmware not reported" : `${told.text} ${told.version}${build}`.trim();
  const words = [name, FIRMWARE[told.state], told.from === "plain" ? "not verified" : null, told.changed ? "changed since calibration" : null];
  const warn = told.changed || ["bad", "other", "outdated", "not-reported"].includes(told.state);
  const title = told.image ? `Image ${told.image}. The node reports this; it is no proof of the image.` : "The node reports this; it is no proof of the image.";
  return h("span", { class: warn ? "firmware warn" : "firmware", title }, icon(warn ? "warn" : "list"), words.filter(Boolean).join(", "));
}

/** Battery and charging as text. */
function power(told) {
  const level = typeof told.percent === "number" ? `${told.percent} %` : "level unknown";
  const words = { charging: "charging", wanted: "needs charging", full: "full", error: "charging error" }[told.charging];
  const low = told.low || (typeof told.percent === "number" && told.percent < 10);
  return h("span", { class: low ? "warn" : "" }, icon(told.charging === "charging" ? "charge" : "battery"), [level, words, low ? "low" : null].filter(Boolean).join(", "));
}

/** One line of the security check, with its reason. */
export function checkLine(check) {
  if (check.print) return h("li", {}, h("span", { class: "check-name" }, "Key fingerprint"), h("code", { class: "print" }, grouped(check.print)));
  const [tone, sign, words] = RESULTS[check.result] ?? RESULTS.skipped;
  return h("li", {}, chip(tone, sign, words), h("span", { class: "check-name" }, check.name), check.why ? h("span", { class: "hint" }, check.why) : null);
}

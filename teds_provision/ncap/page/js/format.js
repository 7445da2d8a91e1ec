// Formats numbers, times and names.

const ROUNDING = 1e-7; // of an end of a range: half a step of 32 bits is at most 6e-8 of it; the station allows 5e-7

/** Digits after the point so that the uncertainty has two figures; without one, five figures in all. */
function places(value, uncertainty) {
  if (uncertainty > 0) return Math.min(9, Math.max(0, 1 - Math.floor(Math.log10(uncertainty) + 1e-6)));
  const size = Math.abs(value);
  return size >= 1e5 || size === 0 ? 0 : Math.min(9, Math.max(0, 4 - Math.floor(Math.log10(size))));
}

/** A value for display; "none" if there is none. Very large and very small ones as 1.2345e-9. An angle that rounds to
 * the end of its turn is shown as the beginning. */
export function number(value, uncertainty = null, turn = null) {
  if (typeof value !== "number" || !Number.isFinite(value)) return "none";
  const size = Math.abs(value);
  if (size !== 0 && (size >= 1e7 || (size < 1e-4 && !(uncertainty > size)))) return sign(value.toExponential(4));
  const digits = places(value, uncertainty);
  const text = value.toFixed(digits);
  return sign(turn && Number(text) >= Number((turn.low + turn.size).toFixed(digits)) ? turn.low.toFixed(digits) : text);
}

/** A channel's value in its unit; a rest from rounding in the conversion is shown as 0. */
export function reading(value, channel, uncertainty = channel.uncertainty) {
  const size = Math.max(...[channel.low, channel.high, channel.scale?.offset].map((end) => Math.abs(end) || 0));
  return number(Math.abs(value) < 1e-9 * size ? 0 : value, uncertainty, channel.turn);
}

/** Text instead of the last value if there is no number: never measured, raw values only, not valid. */
export function figure(last, channel) {
  if (!last) return "no value yet";
  if (typeof last.value === "number") return reading(last.value, channel);
  if (!channel.problem) return "not valid";
  const raw = rawOf(last);
  return raw === "" ? "raw value only" : `${raw} raw`;
}

/** The raw value of a channel without calibration, as text; empty if it is not known. */
function rawOf(last) {
  if (typeof last.raw === "number") return sign(Number.isInteger(last.raw) ? String(last.raw) : String(Number(last.raw.toPrecision(6))));
  return typeof last.raw === "string" && last.raw.length <= 16 ? last.raw : "";
}

/** Tooltip: why a channel shows no number; empty if unknown. */
export function whyNoNumber(last, channel, report) {
  if (!last || typeof last.value === "number") return "";
  const reasons = (report?.invalid_why ?? []).filter((one) => one.channel === channel.number);
  return channel.problem ?? reasons.map((one) => `${one.count}: ${one.why}`).join("; ");
}

/** Like number, without trailing zeros. */
export function short(value) {
  if (typeof value !== "number" || !Number.isFinite(value)) return "none";
  return sign(String(Number(value.toPrecision(4))));
}

/** Four figures of a number, but never beyond the ends of its range, which the station would refuse. It takes what an
 * end lost to its 32 bits (110 for 109.9999994). */
export function within(value, low, high) {
  const rounded = Number(value.toPrecision(4));
  const least = low ?? -Infinity, most = high ?? Infinity;
  if (rounded < least - ROUNDING * Math.abs(least)) return low;
  return rounded > most + ROUNDING * Math.abs(most) ? high : rounded;
}

const sign = (words) => words.replaceAll("-", "\u2212");

/** "0 to 110 mm", "from 0 mm", or "not stated". */
export function range(channel) {
  const unit = channel.unit ? ` ${channel.unit}` : "";
  const [low, high] = [channel.low, channel.high].map((end) => (typeof end === "number" ? short(end) : null));
  if (low !== null && high !== null) return `${low} to ${high}${unit}`;
  if (low !== null) return `from ${low}${unit}`;
  return high !== null ? `up to ${high}${unit}` : "not stated";
}

/** "100 Hz", "2.5 kHz". */
export function hertz(rate) {
  if (typeof rate !== "number" || !(rate > 0)) return "not stated";
  return rate >= 1000 ? `${short(rate / 1000)} kHz` : `${short(rate)} Hz`;
}

/** How long ago, rounded so that the text seldom changes. */
export function age(seconds) {
  if (typeof seconds !== "number" || !Number.isFinite(seconds)) return "never";
  if (seconds < 1.5) return "now";
  if (seconds < 90) return `${Math.round(seconds)} s ago`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min ago`;
  if (seconds < 129600) return `${Math.round(seconds / 3600)} h ago`;
  return `${Math.round(seconds / 86400)} days ago`;
}

/** Clock time of a unix second or an ISO string: 14:03:07; with the date if it is not today. */
export function clock(time) {
  if (time === null || time === undefined || time === "") return "never";
  const moment = typeof time === "number" ? new Date(time * 1000) : new Date(time);
  if (Number.isNaN(moment.getTime())) return String(time);
  const pad = (part) => String(part).padStart(2, "0");
  const hours = `${pad(moment.getHours())}:${pad(moment.getMinutes())}:${pad(moment.getSeconds())}`;
  if (moment.toDateString() === new Date().toDateString()) return hours;
  return `${moment.getFullYear()}-${pad(moment.getMonth() + 1)}-${pad(moment.getDate())} ${hours}`;
}

/** Display name of a node: its name, or else the first digits of its UUID. */
export function nameOf(node) {
  return node?.name || (node?.uuid ? `node ${node.uuid.slice(0, 8)}` : "unknown node");
}

const { compare } = new Intl.Collator(undefined, { numeric: true, sensitivity: "base" });

/** Names of nodes in their order, the first of them if there are many: "arm, hand and 98 more". */
export function namesOf(nodes, most = 8) {
  const names = [...nodes].sort(byName).map(nameOf);
  return names.length > most + 1 ? `${names.slice(0, most).join(", ")} and ${names.length - most} more` : names.join(", ");
}

/** Order of nodes in lists: by name, "finger 2" before "finger 10"; equal names by UUID. */
export const byName = (one, other) => compare(nameOf(one), nameOf(other)) || compare(one.uuid, other.uuid);

/** Display name of a channel. */
export function channelName(channel) {
  return channel.name || `channel ${channel.number}`;
}

/** "1 node", "2 nodes". */
export function count(many, one, more = `${one}s`) {
  return `${many} ${many === 1 ? one : more}`;
}

/** A UUID in groups of four, for reading aloud and comparing. */
export function grouped(hex) {
  return (hex ?? "").replace(/(.{4})(?=.)/g, "$1 ");
}

const VERDICTS = {
  authentic: ["good", "good", "Authentic", "Signature, trust and key proof are valid."],
  unproven: ["warn", "ask", "Unproven", "The node could not prove that it holds its key."],
  unsigned: ["warn", "warn", "Unsigned", "Nobody signed this datasheet."],
  "not authentic": ["bad", "bad", "Not authentic", "A security check failed. Do not trust its values."],
};

/** "at 14:03:07" if that was today, else "on 2026-11-25"; empty for no time. */
function dated(time) {
  if (typeof time !== "number") return "";
  const words = clock(time);
  return words.length > 8 ? ` on ${words.slice(0, 10)}` : ` at ${words}`;
}

/** Tone, icon, word and meaning of the verdict on a node or a datasheet; for an absent node in grey, with its time. */
export function verdict(of) {
  const [tone, sign, words, why] = judged(of);
  // what is there now was not read, so it may be another board under this UUID
  const unproven = of.present && of.measuring?.state !== "running" && of.problem;
  if (unproven && tone !== "plain") return ["warn", "ask", "Not verified", `It has not proven itself since it came. Last verdict${dated(of.read?.at)}: ${words}.`];
  if (of.present !== false || tone === "plain") return [tone, sign, words, why];
  return ["plain", sign, `${words}${dated(of.read?.at)}`, `${why} The node is not connected now.`];
}

function judged(of) {
  if (of.unverified) return ["warn", "warn", "Unverified", "Nobody signed this datasheet: name, channels and values come from the node itself."];
  const known = VERDICTS[of.verdict];
  if (known && of.from === "kept") return [...known.slice(0, 3), `${known[3]} Only the Security TEDS was read now; the rest is from the last reading.`];
  if (known) return known;
  return ["plain", "ask", "Not checked", "This node has not been verified yet."];
}

/** "held by north, south (epoch 3), datasheet 7 by north, firmware not reported". */
export function heldBy(says) {
  const who = Object.values(says.holders).flat();
  const held = who.length ? `held by ${who.join(", ")} (epoch ${says.epoch})` : "no holder";
  const written = says.written_by ? `, datasheet ${says.sequence} by ${says.written_by}` : "";
  const older = says.older_than ? `; the datasheet known here is older than ${says.older_than} wrote` : "";
  return `${held}${written}, ${firmware(says.firmware)}${older}`;
}

/** "firmware nrf/loadcell 1.3.0 (seen by south)"; null: no station reports any. */
function firmware(told) {
  if (!told) return "firmware not reported";
  if (told.version === null) return `firmware not reported (asked by ${told.by})`;
  return `firmware ${`${told.text} ${told.version}${told.build ? `+${told.build}` : ""}`.trim()} (seen by ${told.by})`;
}

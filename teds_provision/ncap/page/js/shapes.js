// Converts the API's answers for the views: numbers to display units, times to unix seconds. The API uses SI units; a
// channel's `shown` has the display unit: number = SI × factor + offset.

const KINDS = { sensor: "sensor", actuator: "actuator", "event sensor": "event", event: "event" };

/** Unix seconds of a number or an ISO 8601 text; null for others. */
export function moment(time) {
  if (typeof time === "number") return time;
  const parsed = time ? Date.parse(time) / 1000 : NaN;
  return Number.isFinite(parsed) ? parsed : null;
}

/** The conversion from a channel's SI numbers to its display unit. */
export function scaleOf(wire) {
  const shown = wire.shown ?? {};
  const factor = typeof shown.factor === "number" && shown.factor !== 0 ? shown.factor : 1;
  return { unit: shown.unit ?? wire.unit ?? "", factor, offset: shown.offset ?? 0, si: wire.unit ?? "" };
}

export const toShown = (scale, value) => (typeof value === "number" ? value * scale.factor + scale.offset : null);
export const fromUnit = (scale, value, unit) => (unit && unit === scale.unit ? value : toShown(scale, value));
export const toSi = (scale, value) => (value - scale.offset) / scale.factor;

/** Start and length of an angle sensor's turn, in its display unit; null for other channels. */
function turnOf(wire, scale) {
  const whole = 2 * Math.PI;
  if (wire.unit !== "rad" || KINDS[wire.kind] === "actuator" || !(Math.abs(wire.high - wire.low - whole) < 1e-5)) return null;
  return { low: toShown(scale, wire.low), size: Math.abs(whole * scale.factor) };
}

function channel(wire) {
  const scale = scaleOf(wire);
  const ends = [toShown(scale, wire.low), toShown(scale, wire.high)];
  if (scale.factor < 0) ends.reverse();
  const last = wire.last ? { value: toShown(scale, wire.last.value), raw: wire.last.raw, time: wire.last.time, valid: wire.last.valid } : null;
  return {
    ...wire,
    name: wire.name ?? "",
    kind: KINDS[wire.kind] ?? "sensor",
    scale,
    unit: scale.unit,
    low: ends[0],
    high: ends[1],
    uncertainty: typeof wire.uncertainty === "number" ? Math.abs(wire.uncertainty * scale.factor) : null,
    turn: turnOf(wire, scale),
    last,
    actuator: wire.actuator ? { ...wire.actuator, value: fromUnit(scale, wire.actuator.value, wire.actuator.unit) } : null,
  };
}

const CHARGE = { full: "full", charging: "charging", "in field": "charging", "charging field": "charging" };

function power(wire) {
  if (!wire) return null;
  const flags = wire.flags ?? [];
  if ("level" in wire && !flags.includes("battery")) return null; // it has no battery
  return {
    percent: wire.level ?? wire.percent ?? wire.battery_percent ?? null,
    charging: wire.charging ?? flags.map((flag) => CHARGE[flag]).find(Boolean) ?? null,
    low: flags.includes("too low"),
  };
}

/** What a node's state in a measurement means. */
function modeOf(state) {
  return { running: "measuring", refused: "refused, not measured", lost: "lost, not measured", ended: "not measured" }[state] ?? "waiting to be measured";
}

/** A node. Its verdict comes from the station's stored reading; `heard` is what it sent outside a session. */
export function node(wire) {
  return {
    ...wire,
    name: wire.name ?? "",
    link: wire.via ?? null,
    seen: moment(wire.last_seen),
    verdict: wire.verdict?.verdict ?? null,
    checks: wire.verdict?.checks ?? [],
    from: wire.verdict?.from ?? null,
    read: wire.verdict ? { at: moment(wire.verdict.at), by: wire.verdict.by } : null,
    looked: moment(wire.verified),
    why: wire.problem?.message ?? "",
    cure: wire.problem?.hint ?? "",
    groups: wire.groups ?? [],
    mode: wire.measurement ? modeOf(wire.measuring?.state) : null,
    power: power(wire.power),
    channels: (wire.channels ?? []).map(channel),
  };
}

/** The station. */
export function status(wire) {
  const links = (wire.links ?? []).map((link) => ({
    name: link.virtual ? "virtual transducers" : (link.place ?? "").replace(/^(can|nfc|ble):/, ""),
    kind: link.virtual ? "virtual" : link.via,
    virtual: Boolean(link.virtual),
    state: link.state,
    why: link.problem?.message ?? link.waiting ?? "",
    hint: link.problem?.hint ?? "",
    nodes: link.nodes ?? null,
  }));
  const problem = wire.vault?.problem;
  const vaultProblem = problem ? `${problem.message} ${problem.hint}` : "";
  return { ...wire, now: moment(wire.time), started: moment(wire.started), links, vaultProblem };
}

/** A message of /live as an event with a name. */
export function live(message) {
  if (message.type === "event") return message;
  if (message.type === "values") return { event: "values", channels: message.channels, raw: message.raw ?? {} };
  return { ...message, event: message.type ?? message.event };
}

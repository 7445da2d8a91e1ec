// The state of the page, in one place. Views listen to topics; several changes in one frame notify them once.

import { get, paths } from "./api.js";
import { toast } from "./dom.js";
import { Ring } from "./ring.js";
import * as shapes from "./shapes.js";

const RINGS = 400; // channels with stored points

export const state = {
  connection: "connecting", // connecting, live, lost, signed out
  since: performance.now(),
  refusal: null,
  status: null,
  loaded: false,
  nodes: new Map(), // by UUID; the first thousand
  total: 0, // number of nodes known to the station
  groups: [],
  measurements: [],
  virtual: [],
  updates: [], // of firmware, the newest first
  profiles: [],
  names: [],
  values: new Map(), // "uuid/channel" → {value, time, period}; in SI, because its datasheet may arrive later
  rings: new Map(), // "uuid/channel" → Ring, SI
  runs: new Map(), // UUID → progress of its provisioning
  tapped: null, // {uuid, at}
  offset: 0, // station's clock minus this one's, s
  dropped: 0, // points that the station dropped because this page was too slow
  received: 0,
};

const listeners = new Map();
const waiting = new Set();
let planned = false;

/** Call `listener` after changes of any of these topics; returns a function that ends this. */
export function on(topics, listener) {
  for (const topic of topics.split(" ")) {
    if (!listeners.has(topic)) listeners.set(topic, new Set());
    listeners.get(topic).add(listener);
  }
  return () => topics.split(" ").forEach((topic) => listeners.get(topic)?.delete(listener));
}

/** Announce changes; views are notified in the next frame. */
export function changed(...topics) {
  topics.forEach((topic) => waiting.add(topic));
  if (planned) return;
  planned = true;
  const tell = () => {
    planned = false;
    const heard = new Set([...waiting].flatMap((topic) => [...(listeners.get(topic) ?? [])]));
    waiting.clear();
    heard.forEach((listener) => listener());
  };
  // A hidden page gets no frames, but must be up to date when it is shown.
  if (document.hidden) setTimeout(tell, 200);
  else requestAnimationFrame(tell);
}

/** The station's clock, unix seconds. */
export const now = () => Date.now() / 1000 + state.offset;

export const keyOf = (uuid, channel) => `${uuid}/${channel}`;

/** The last value of a channel in its display unit: streamed, or from the node's description. */
export function lastOf(uuid, channel) {
  const streamed = streamedOf(uuid, channel.number);
  const told = channel.last ?? null;
  if (streamed && (!told || !(told.time > streamed.time))) return streamed;
  return told;
}

/** The last streamed value of a channel, in its display unit. */
export function streamedOf(uuid, number) {
  const streamed = state.values.get(keyOf(uuid, number));
  return streamed && { ...streamed, value: shapes.toShown(scaleOf(uuid, number), streamed.value) };
}

/** True if a value is too old to count as the present one. */
export function isStale(last) {
  return !last || state.connection !== "live" || now() - last.time > Math.max(2, 3 * (last.period ?? 0));
}

export function ringOf(uuid, channel) {
  const key = keyOf(uuid, channel);
  let ring = state.rings.get(key);
  if (!ring) {
    if (state.rings.size >= RINGS) state.rings.delete(state.rings.keys().next().value);
    ring = new Ring();
    state.rings.set(key, ring);
  }
  return ring;
}

/** The measurement that has this node, if any: running, waiting or failed. */
export function measuring(uuid) {
  return state.measurements.find((one) => one.state !== "ended" && membersOf(one).includes(uuid)) ?? null;
}

/** Why this node's measurement prevents changes; empty if it does not. */
export function frozenBy(uuid) {
  const one = measuring(uuid);
  if (!one || one.state === "failed") return "";
  const where = one.group ? ` in group ${one.group}` : "";
  return `This node is being measured${where}${isOfCommand(one) ? ` by the command measure (process ${one.process?.id})` : ""}. Stop the measurement first.`;
}

/** True if a command of this station runs the measurement: only that command can end it. */
export const isOfCommand = (measurement) => measurement.owner === "command";

/** UUIDs of a measurement. */
export function membersOf(measurement) {
  if (measurement.uuids?.length) return measurement.uuids;
  return state.groups.find((group) => group.name === measurement.group)?.uuids ?? [];
}

let listed = 0; // requests for measurements, as a list or with the status; an older answer must not replace a newer one
let newest = 0; // number of the latest answered request

function takeMeasurements(measurements, request) {
  if (request < newest) return;
  newest = request;
  state.measurements = measurements ?? [];
  changed("measurements");
}

let asked = 0; // requests for nodes, all or one; an older answer must not replace a newer one
const single = new Map(); // UUID → the last answered request for that node alone

const LISTS = {
  status: async () => {
    const mine = ++listed;
    state.status = shapes.status(await get("status"));
    if (state.status.now !== null) state.offset = state.status.now - Date.now() / 1000;
    if (state.status.measurements) takeMeasurements(state.status.measurements, mine);
  },
  nodes: async () => {
    const mine = ++asked;
    const { nodes, total } = await get("nodes");
    state.total = total ?? 0;
    const found = new Map((nodes ?? []).map((wire) => [wire.uuid, shapes.node(wire)]));
    for (const [uuid, number] of single) {
      if (number < mine) single.delete(uuid);
      else if (state.nodes.has(uuid)) found.set(uuid, state.nodes.get(uuid));
      else found.delete(uuid);
    }
    found.forEach(forgetOtherUnits);
    state.nodes = found;
    state.loaded = true;
  },
  groups: async () => (state.groups = (await get("groups")).groups ?? []),
  measurements: async () => {
    const mine = ++listed;
    takeMeasurements((await get("measurements")).measurements, mine);
  },
  virtual: async () => (state.virtual = (await get("virtual")).virtual ?? []),
  updates: async () => (state.updates = (await get("updates")).updates ?? []),
  profiles: async () => (state.profiles = (await get("profiles")).profiles ?? []),
  names: async () => (state.names = (await get("names")).names ?? []),
};

/** Drop stored points of channels whose SI unit has changed: the curve would be drawn in the new unit. */
function forgetOtherUnits(node) {
  for (const channel of node.channels ?? []) {
    const before = state.nodes.get(node.uuid)?.channels?.find((one) => one.number === channel.number);
    if (before && (before.scale.si !== channel.scale.si || Boolean(before.problem) !== Boolean(channel.problem))) state.rings.get(keyOf(node.uuid, channel.number))?.clear();
  }
}

const asking = new Map(); // list → true if it must be fetched again after the present answer

/** Fetch lists. A request during another one causes one more fetch after it. */
export async function refresh(...lists) {
  await Promise.all(lists.map(fetchOne));
}

async function fetchOne(list) {
  if (asking.has(list)) {
    asking.set(list, true);
    return;
  }
  asking.set(list, false);
  try {
    await LISTS[list]();
    changed(list);
  } catch (error) {
    if (error.status !== 0 && error.status !== 401) toast("bad", error.message, error.hint);
  }
  const again = asking.get(list);
  asking.delete(list);
  if (again) await fetchOne(list);
}

const due = new Set(); // UUIDs of changed nodes

/** Fetch one node again, soon: events come in bursts. */
function refreshNode(uuid) {
  if (!due.size) setTimeout(fetchDue, 60);
  due.add(uuid);
}

async function fetchDue() {
  const uuids = [...due];
  due.clear();
  if (uuids.length > 5) return refresh("nodes");
  const mine = ++asked;
  const answers = await Promise.allSettled(uuids.map((uuid) => get(paths.node(uuid))));
  answers.forEach((answer, index) => {
    const uuid = uuids[index];
    const gone = answer.reason?.status === 404;
    if ((single.get(uuid) ?? 0) > mine || (answer.status === "rejected" && !gone)) return;
    single.set(uuid, mine);
    if (gone) state.nodes.delete(uuid);
    else {
      const node = shapes.node(answer.value);
      forgetOtherUnits(node);
      state.nodes.set(uuid, node);
    }
  });
  return changed("nodes");
}

/** The lists that depend on an event's subject. */
const AFTER = {
  measurement: ["measurements", "nodes", "status"],
  group: ["groups", "nodes"],
  virtual: ["virtual", "nodes"],
  names: ["names"],
  detection: ["status", "nodes"],
  sink: ["status", "measurements"],
  link: ["status", "nodes"],
  vault: ["status", "nodes", "measurements"],
  log: [],
};

/** Handle a message of the WebSocket. */
export function take(message) {
  const event = shapes.live(message);
  const taker = TAKERS[event.event];
  if (taker) taker(event);
  else if (AFTER[event.event]) refresh(...AFTER[event.event]);
  changed(event.event);
}

const everything = () => refresh("status", "nodes", "groups", "measurements", "virtual", "profiles", "updates");

const TAKERS = {
  hello: everything,
  resync: everything,
  store: everything,
  beat: () => {},
  dropped: (event) => (state.dropped += event.messages ?? 0),
  values: (event) => {
    for (const [key, [times, values]] of Object.entries(event.channels)) takeStream(key, times, values);
    for (const [key, [times, values]] of Object.entries(event.raw)) takeStream(key, times, values, true);
  },
  node: (event) => {
    refreshNode(event.uuid);
    if (["running", "lost", "refused", "waiting", "ended", "idle"].includes(event.state)) refresh("status");
    // Open the tapped node at once: no click is needed.
    if (event.state === "tapped") {
      state.tapped = { uuid: event.uuid, at: performance.now() };
      changed("tap");
    }
  },
  provision: (event) => {
    if (!state.runs.has(event.uuid) && state.runs.get("next")?.state === "waiting" && event.state === "running") {
      state.runs.set(event.uuid, state.runs.get("next")); // the run for "the next node" now has a UUID
      state.runs.delete("next");
    }
    const run = state.runs.get(event.uuid) ?? { steps: [] };
    const steps = event.state === "waiting" ? [] : [...run.steps];
    if (event.step) {
      const place = steps.findIndex((step) => step.name === event.step);
      const step = { name: event.step, result: event.result ?? "running", detail: event.detail };
      if (place < 0) steps.push(step);
      else steps[place] = step;
    }
    state.runs.set(event.uuid, { ...run, ...event, steps, heard: performance.now() });
    if (event.state === "done") refreshNode(event.uuid);
  },
  update: (event) => {
    const update = state.updates.find((one) => one.id === event.id);
    if (!update || update.state !== event.state) refresh("updates");
    else if (event.board) update.boards = update.boards.map((one) => (one.uuid === event.uuid ? event.board : one));
    if (event.board?.result) refreshNode(event.uuid);
  },
  actuator: (event) => {
    const channel = state.nodes.get(event.uuid)?.channels?.find((one) => one.number === event.channel);
    if (channel) channel.actuator = { value: shapes.fromUnit(channel.scale, event.value, event.unit), safe: event.safe };
  },
};

/** Points of a channel: values, or `raw` numbers of one without calibration. */
function takeStream(key, times, values, raw = false) {
  const [uuid, channel] = key.split("/");
  const ring = ringOf(uuid, channel);
  // it was calibrated meanwhile: the numbers have another meaning
  if (raw !== (state.values.get(key)?.isRaw ?? raw)) ring.clear();
  for (let index = 0; index < times.length; index++) ring.push(times[index], values[index] ?? NaN);
  state.received += times.length;
  if (!times.length) return;
  const time = times.at(-1);
  const value = values.at(-1);
  const old = state.values.get(key);
  const period = old && time > old.time ? (time - old.time) / times.length : (old?.period ?? 0);
  state.values.set(key, raw ? { value: null, raw: value, time, period, valid: false, isRaw: true } : { value, time, period, valid: value !== null, isRaw: false });
}

const PLAIN = { factor: 1, offset: 0 };
export const scaleOf = (uuid, number) => state.nodes.get(uuid)?.channels?.find((one) => one.number === number)?.scale ?? PLAIN;

// What the page knows, in one place. Views listen to topics; several changes in one frame are told once.

import { get, paths } from "./api.js";
import { toast } from "./dom.js";
import { Ring } from "./ring.js";
import * as shapes from "./shapes.js";

const RINGS = 400; // channels whose course is kept at once

export const state = {
  connection: "connecting", // connecting, live, lost, signed out
  since: performance.now(),
  refusal: null,
  status: null,
  loaded: false,
  nodes: new Map(), // by UUID; the first thousand
  total: 0, // how many the station knows
  groups: [],
  measurements: [],
  virtual: [],
  updates: [], // of firmware, the newest first
  profiles: [],
  names: [],
  values: new Map(), // "uuid/channel" → {value, time, period}; SI, for its datasheet may come later than its values
  rings: new Map(), // "uuid/channel" → Ring, SI
  runs: new Map(), // UUID → what provisioning said so far
  tapped: null, // {uuid, at}
  offset: 0, // station's clock less this one's, s
  dropped: 0, // points that this page was too slow for, told by the station
  received: 0,
};

const listeners = new Map();
const waiting = new Set();
let planned = false;

/** Call `listener` after changes of any of these topics; returns what ends it. */
export function on(topics, listener) {
  for (const topic of topics.split(" ")) {
    if (!listeners.has(topic)) listeners.set(topic, new Set());
    listeners.get(topic).add(listener);
  }
  return () => topics.split(" ").forEach((topic) => listeners.get(topic)?.delete(listener));
}

/** Say that something changed; views hear of it in the next frame. */
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
  // A hidden page paints no frames, but what it shows shall be true when it is looked at.
  if (document.hidden) setTimeout(tell, 200);
  else requestAnimationFrame(tell);
}

/** The station's clock, unix seconds. */
export const now = () => Date.now() / 1000 + state.offset;

export const keyOf = (uuid, channel) => `${uuid}/${channel}`;

/** The last value of a channel, in the unit for people: what was streamed, or what the station told with the node. */
export function lastOf(uuid, channel) {
  const streamed = streamedOf(uuid, channel.number);
  const told = channel.last ?? null;
  if (streamed && (!told || !(told.time > streamed.time))) return streamed;
  return told;
}

/** The last value of a channel that was streamed, in the unit for people. */
export function streamedOf(uuid, number) {
  const streamed = state.values.get(keyOf(uuid, number));
  return streamed && { ...streamed, value: shapes.toShown(scaleOf(uuid, number), streamed.value) };
}

/** Whether a value is too old to be taken for the present one. */
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

/** The measurement that has this node, if any: it runs, waits or has failed. */
export function measuring(uuid) {
  return state.measurements.find((one) => one.state !== "ended" && membersOf(one).includes(uuid)) ?? null;
}

/** Why the measurement that has this node keeps others from changing it; empty if nothing does. */
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

let listed = 0; // requests for measurements, as a list or with the status; an earlier one's answer replaces no later one's
let newest = 0; // the latest of them that was answered

function takeMeasurements(measurements, request) {
  if (request < newest) return;
  newest = request;
  state.measurements = measurements ?? [];
  changed("measurements");
}

let asked = 0; // requests for nodes, all of them or one; an answer to an earlier one replaces none to a later
const single = new Map(); // UUID → the last request for that node alone which was answered

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

/** Forget the course of channels that had another SI unit until now: the curve would be drawn in the new one. */
function forgetOtherUnits(node) {
  for (const channel of node.channels ?? []) {
    const before = state.nodes.get(node.uuid)?.channels?.find((one) => one.number === channel.number);
    if (before && (before.scale.si !== channel.scale.si || Boolean(before.problem) !== Boolean(channel.problem))) state.rings.get(keyOf(node.uuid, channel.number))?.clear();
  }
}

const asking = new Map(); // list → whether it is to be asked once more after this answer

/** Fetch a list anew. Asked twice while an answer is on its way, it is fetched once more after it. */
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

const due = new Set(); // UUIDs of nodes that changed

/** Fetch one node anew, soon: events come in flocks. */
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

/** What hangs on a list that an event names. */
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

/** Take one message of the WebSocket. */
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
    // Whoever lays a node on the reader wants to see that very node: no button is needed.
    if (event.state === "tapped") {
      state.tapped = { uuid: event.uuid, at: performance.now() };
      changed("tap");
    }
  },
  provision: (event) => {
    if (!state.runs.has(event.uuid) && state.runs.get("next")?.state === "waiting" && event.state === "running") {
      state.runs.set(event.uuid, state.runs.get("next")); // the node for which "the next one" was asked has come
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
  if (raw !== (state.values.get(key)?.isRaw ?? raw)) ring.clear(); // calibrated meanwhile: other numbers
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

// The last hour of a channel from the station: fetched once, then only new bins. A reload loses nothing.

import { get, paths } from "./api.js";
import { now, ringOf } from "./state.js";

const HOUR = 3600; // s
const FINE = 58; // s for which the station has bins of 10 ms, less some time for its answer
const LIVE = 120; // s shown by the live curves

const NOTHING = { bin: 1, time: [], low: [], high: [], count: [], invalid: [], lost: [], segment: [], segments: [], rate: null };
const LISTS = ["time", "low", "high", "count", "invalid", "lost", "segment"];

/** SI unit of the newest segment of these bins; undefined without bins. */
const newestUnit = (bins) => unitOf(bins, bins.segment.at(-1));
const RAW = "raw"; // used instead of an SI unit for a channel without calibration
const unitOf = (bins, segment) => {
  const found = bins.segments.find((one) => one.id === segment);
  return found?.raw ? RAW : found?.unit;
};

/** Bins of a channel between two moments, SI; empty if nothing was measured. */
export async function between(uuid, number, from, until, points) {
  try {
    return await get(`${paths.past(uuid)}?channel=${number}&from=${from.toFixed(3)}&until=${until.toFixed(3)}&points=${points}`);
  } catch (error) {
    if (error.status === 404) return { ...NOTHING };
    throw error;
  }
}

/** The hour of one channel, in bins of a second. */
export class Hour {
  constructor(uuid, number) {
    Object.assign(this, { uuid, number, bins: { ...NOTHING } });
    this.asking = false;
  }

  /** Fetch new bins. Errors are ignored: the page reports a lost station elsewhere. */
  async refresh() {
    if (this.asking) return;
    this.asking = true;
    try {
      const held = this.bins.time;
      // Request more than a minute, so that bins are a second wide; the last one held was not complete yet.
      const from = held.length ? Math.min(held.at(-1), now() - 70) : now() - HOUR;
      const fresh = await between(this.uuid, this.number, from, now() + 5, HOUR);
      const first = fresh.time[0] ?? Infinity;
      // the station's clock was set back
      const back = held.length && fresh.time.length && fresh.time.at(-1) < held.at(-1) - 5;
      const old = held.findIndex((time) => time > now() - HOUR);
      const kept = back || old < 0 ? [0, 0] : [old, held.findLastIndex((time) => time < first) + 1];
      const bins = { ...this.bins, bin: 1, rate: fresh.rate };
      for (const list of LISTS) bins[list] = [...this.bins[list].slice(...kept), ...fresh[list]];
      bins.segments = [...this.bins.segments.filter((one) => !fresh.segments.some((other) => other.id === one.id)), ...fresh.segments];
      this.bins = bins;
    } catch {
      // The connection reports this.
    } finally {
      this.asking = false;
    }
  }

  /** SI unit of the present values; undefined if there are none yet. */
  get unit() {
    return newestUnit(this.bins);
  }

  /** Lost and invalid samples between two moments. */
  faults(from, to) {
    const found = { lost: 0, invalid: 0 };
    for (let at = this.bins.time.length - 1; at >= 0 && this.bins.time[at] >= from; at--) {
      if (this.bins.time[at] > to) continue;
      found.lost += this.bins.lost[at];
      found.invalid += this.bins.invalid[at];
    }
    return found;
  }
}

/** Fill a live curve with values measured before this page was opened. */
export async function seed(uuid, number) {
  const time = now();
  const [rough, fine] = await Promise.all([between(uuid, number, time - LIVE, time - FINE, LIVE), between(uuid, number, time - FINE, time + 1, HOUR)]);
  const points = [];
  const unit = newestUnit(fine.time.length ? fine : rough);
  let segment;
  for (const bins of [rough, fine]) {
    bins.time.forEach((at, place) => {
      const [low, high] = [bins.low[place] ?? NaN, bins.high[place] ?? NaN];
      if (bins === rough && at >= (fine.time[0] ?? Infinity)) return;
      if (unitOf(bins, bins.segment[place]) !== unit) return; // from an earlier board that measured another quantity
      if (segment !== undefined && segment !== bins.segment[place]) points.push([at, NaN]);
      segment = bins.segment[place];
      points.push([at, low]);
      if (high > low) points.push([at + bins.bin / 2, high]);
    });
  }
  ringOf(uuid, number).before(points);
}

/** Bins in the form of `Ring.bins`: three entries per column: least, greatest, and null if the line ends. It ends
 * before a gap longer than `silence`, if no value was valid, and before a new segment (another calibration or zero).
 * Bins in another SI unit than `unit` are left out, unless none is given. */
export function columnsOf(bins, from, to, columns, silence, unit) {
  const out = new Array(3 * columns).fill(undefined);
  const width = (to - from) / columns;
  const quiet = Math.max(1.5 * bins.bin, silence);
  let before = NaN;
  let last = -1;
  let segment;
  bins.time.forEach((time, place) => {
    if (unit !== undefined && unitOf(bins, bins.segment[place]) !== unit) return;
    const column = Math.floor((time + bins.bin / 2 - from) / width);
    if (column < 0 || column >= columns) return;
    const ends = time - before > quiet || (segment !== undefined && segment !== bins.segment[place]);
    if (ends && column > 0 && column !== last) out[3 * column - 1] = null;
    before = time;
    if (segment !== bins.segment[place] && column === last) out[3 * column] = out[3 * column + 1] = undefined; // two meanings: the newer one
    segment = bins.segment[place];
    const [low, high, at] = [bins.low[place], bins.high[place], 3 * column];
    if (typeof low !== "number") {
      if (out[at] === undefined) out[at] = out[at + 1] = null;
    } else if (column === last && typeof out[at] === "number") {
      [out[at], out[at + 1]] = [Math.min(out[at], low), Math.max(out[at + 1], high)];
    } else {
      [out[at], out[at + 1]] = [low, high];
    }
    last = column;
  });
  return out;
}

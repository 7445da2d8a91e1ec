// The last hour of a channel, as the station keeps it: fetched once, then only what is new. A reload loses nothing.

import { get, paths } from "./api.js";
import { now, ringOf } from "./state.js";

const HOUR = 3600; // s
const FINE = 58; // s of which the station has bins of 10 ms, less what may pass until it answers
const LIVE = 120; // s that the live curves show

const NOTHING = { bin: 1, time: [], low: [], high: [], count: [], invalid: [], lost: [], segment: [], segments: [], rate: null };
const LISTS = ["time", "low", "high", "count", "invalid", "lost", "segment"];

/** SI unit of the newest segment of these bins; undefined where there are none. */
const newestUnit = (bins) => unitOf(bins, bins.segment.at(-1));
const RAW = "raw"; // in place of the SI unit: numbers of a channel without calibration
const unitOf = (bins, segment) => {
  const found = bins.segments.find((one) => one.id === segment);
  return found?.raw ? RAW : found?.unit;
};

/** Bins of a channel between two moments, SI; none where nothing was measured. */
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

  /** Fetch what came since; quietly nothing where the station does not answer: the page says so elsewhere. */
  async refresh() {
    if (this.asking) return;
    this.asking = true;
    try {
      const held = this.bins.time;
      // More than a minute is asked for, so that it comes in bins of a second; the last one held was not whole yet.
      const from = held.length ? Math.min(held.at(-1), now() - 70) : now() - HOUR;
      const fresh = await between(this.uuid, this.number, from, now() + 5, HOUR);
      const first = fresh.time[0] ?? Infinity;
      const back = held.length && fresh.time.length && fresh.time.at(-1) < held.at(-1) - 5; // the station's clock was set
      const old = held.findIndex((time) => time > now() - HOUR);
      const kept = back || old < 0 ? [0, 0] : [old, held.findLastIndex((time) => time < first) + 1];
      const bins = { ...this.bins, bin: 1, rate: fresh.rate };
      for (const list of LISTS) bins[list] = [...this.bins[list].slice(...kept), ...fresh[list]];
      bins.segments = [...this.bins.segments.filter((one) => !fresh.segments.some((other) => other.id === one.id)), ...fresh.segments];
      this.bins = bins;
    } catch {
      // told by the connection
    } finally {
      this.asking = false;
    }
  }

  /** SI unit of the values that come now; undefined where none came yet. */
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

/** Fill what a live curve shows with what was measured before this page was opened. */
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
      if (unitOf(bins, bins.segment[place]) !== unit) return; // of a board that measured something else then
      if (segment !== undefined && segment !== bins.segment[place]) points.push([at, NaN]);
      segment = bins.segment[place];
      points.push([at, low]);
      if (high > low) points.push([at + bins.bin / 2, high]);
    });
  }
  ringOf(uuid, number).before(points);
}

/**
 * Bins as `Ring.bins` gives points: three entries for each of `columns`, the least, the greatest, and null where the line
 * ends. It ends where nothing came for longer than `silence`, where nothing was valid, and where a new segment begins
 * (another calibration or zero). Bins in another SI unit than `unit` are left out, unless none is given.
 */
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

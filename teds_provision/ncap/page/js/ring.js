// The last points of a channel, in arrays of a fixed size: memory does not grow, however long the page is open.

const POINTS = 12000; // two minutes at the 100 points a second that the station sends at most

const TRAVEL = 60; // a curve that goes up and down by so many times its own height shows no dashes

/** True if dashes would not be visible, since the curve goes up and down so often; painting them takes many times as
 * long. */
export function restless(course) {
  let [low, high, before, travel] = [Infinity, -Infinity, null, 0];
  for (const value of course) {
    if (typeof value !== "number") continue;
    if (value < low) low = value;
    if (value > high) high = value;
    if (before !== null) travel += Math.abs(value - before);
    before = value;
  }
  return travel > TRAVEL * Math.max(0, high - low);
}

/** Times (unix s) and values; NaN if there was none. */
export class Ring {
  constructor(size = POINTS) {
    this.size = size;
    this.time = new Float64Array(size);
    this.value = new Float32Array(size);
    this.next = 0;
    this.held = 0;
    this.total = 0;
  }

  push(time, value) {
    if (this.held && time < this.newest) this.clear(); // the clock went back: start again
    this.time[this.next] = time;
    this.value[this.next] = value;
    this.next = (this.next + 1) % this.size;
    this.held = Math.min(this.held + 1, this.size);
    this.total += 1;
  }

  clear() {
    this.next = this.held = 0;
  }

  /** Put points [[time, value] …] before the stored ones: values measured before this page was opened. */
  before(points) {
    const start = (this.next + this.size - this.held) % this.size;
    const held = Array.from({ length: this.held }, (_, step) => {
      const place = (start + step) % this.size;
      return [this.time[place], this.value[place]];
    });
    const first = held[0]?.[0] ?? Infinity;
    const total = this.total;
    this.clear();
    for (const [time, value] of [...points.filter(([time]) => time < first), ...held]) this.push(time, value);
    this.total = total;
  }

  get newest() {
    return this.held ? this.time[(this.next + this.size - 1) % this.size] : NaN;
  }

  /** Lowest and highest of each of `columns` equal bins from `from` to `to`, in order of time, and a third entry that
   * is null if the line ends there. A bin without a point is undefined. The line ends before a gap longer than
   * `silence` seconds, and if there is no value: none was valid, or an angle continued at the other end of its turn. If
   * it ends within a bin, the longest piece there is drawn. */
  bins(from, to, columns, silence) {
    const out = new Array(3 * columns).fill(undefined);
    const width = (to - from) / columns;
    const start = (this.next + this.size - this.held) % this.size;
    let before = NaN;
    let column = -1;
    let pieces = []; // of this bin: pieces of the line without a gap
    let piece = null;
    let ended = false; // true if the line has ended in this bin
    const settle = () => {
      if (column < 0) return;
      const at = 3 * column;
      const best = pieces.reduce((one, other) => (one && one.high - one.low >= other.high - other.low ? one : other), null);
      if (!best) out[at] = out[at + 1] = null;
      else [out[at], out[at + 1]] = best.rising ? [best.low, best.high] : [best.high, best.low];
      if (best?.anew && at) out[at - 1] = null;
      if (best !== piece) out[at + 2] = null;
    };
    for (let step = this.after(from); step < this.held; step++) {
      const place = (start + step) % this.size;
      const time = this.time[place];
      const next = Math.floor((time - from) / width);
      if (next >= columns) break;
      if (next !== column) {
        settle();
        if (time - before > silence && next > column + 1) out[3 * next - 1] = null;
        column = next;
        [pieces, piece, ended] = [[], null, false];
      }
      before = time;
      const value = this.value[place];
      if (Number.isNaN(value)) [piece, ended] = [null, true];
      else if (!piece) pieces.push((piece = { low: value, high: value, rising: true, anew: ended }));
      else if (value < piece.low) [piece.low, piece.rising] = [value, false];
      else if (value > piece.high) [piece.high, piece.rising] = [value, true];
    }
    settle();
    return out;
  }

  /** How many of the held points come before `from` (times ascend). */
  after(from) {
    const start = (this.next + this.size - this.held) % this.size;
    let [low, high] = [0, this.held];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.time[(start + middle) % this.size] < from) low = middle + 1;
      else high = middle;
    }
    return low;
  }
}

// The last points of a channel, in arrays of a fixed size: memory does not grow, however long the page is open.

const POINTS = 12000; // two minutes at the 100 points a second that the station sends at most

/** Times (unix s) and values; NaN where there was none. */
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
    if (this.held && time < this.newest) this.clear(); // measured anew, by another clock
    this.time[this.next] = time;
    this.value[this.next] = value;
    this.next = (this.next + 1) % this.size;
    this.held = Math.min(this.held + 1, this.size);
    this.total += 1;
  }

  clear() {
    this.next = this.held = 0;
  }

  get newest() {
    return this.held ? this.time[(this.next + this.size - 1) % this.size] : NaN;
  }

  /**
   * Lowest and highest of each of `columns` equal bins from `from` to `to`, two entries a bin, in the order in which they
   * came. A bin without a point is undefined, one in a silence longer than `silence` seconds, or without a value, null.
   */
  bins(from, to, columns, silence) {
    const out = new Array(2 * columns).fill(undefined);
    const width = (to - from) / columns;
    const start = (this.next + this.size - this.held) % this.size;
    let before = NaN;
    let column = -1;
    let [low, high, rising] = [NaN, NaN, true];
    const settle = () => {
      if (column < 0) return;
      const at = 2 * column;
      if (Number.isNaN(low)) out[at] = out[at + 1] = null;
      else [out[at], out[at + 1]] = rising ? [low, high] : [high, low];
    };
    for (let step = this.after(from); step < this.held; step++) {
      const place = (start + step) % this.size;
      const time = this.time[place];
      const next = Math.floor((time - from) / width);
      if (next >= columns) break;
      if (next !== column) {
        settle();
        if (time - before > silence && next > column + 1) out[2 * next - 1] = null;
        column = next;
        low = high = NaN;
      }
      before = time;
      const value = this.value[place];
      if (Number.isNaN(value)) continue;
      if (Number.isNaN(low)) low = high = value;
      else if (value < low) [low, rising] = [value, false];
      else if (value > high) [high, rising] = [value, true];
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

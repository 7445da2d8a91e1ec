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

  /** Lowest and highest of each of `columns` equal bins from `from` to `to`, two entries a bin. Silence is null. */
  bins(from, to, columns, silence) {
    const out = new Array(2 * columns).fill(undefined);
    const width = (to - from) / columns;
    const start = (this.next + this.size - this.held) % this.size;
    let before = NaN;
    for (let step = this.after(from); step < this.held; step++) {
      const place = (start + step) % this.size;
      const time = this.time[place];
      const column = Math.floor((time - from) / width);
      if (column >= columns) break;
      const value = this.value[place];
      const at = 2 * column;
      if (time - before > silence && at > 0 && out[at] === undefined) out[at - 1] = out[at - 1] ?? null;
      before = time;
      if (Number.isNaN(value)) {
        if (out[at] === undefined) out[at] = out[at + 1] = null;
      } else if (out[at] === undefined || out[at] === null) {
        out[at] = out[at + 1] = value;
      } else if (value < out[at]) out[at] = value;
      else if (value > out[at + 1]) out[at + 1] = value;
    }
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

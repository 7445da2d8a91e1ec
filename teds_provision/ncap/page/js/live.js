// The WebSocket: values and events as they come. A silent connection is noticed within two seconds.

import { get, liveAddress } from "./api.js";

const SILENCE = 1500; // ms without a beat (two a second): the connection counts as lost
const LOOK = 200; // ms between looks
const NOT_GOOD = 1008; // the station closed it: this browser's token is no longer valid
const WAIT = [300, 600, 1000, 2000, 3000]; // ms before the next try

/** Connects, watches, reconnects. `on.state(state, error)`: "live", "lost", "signed out". `on.event(event)`. */
export class Live {
  constructor(on) {
    this.on = on;
    this.tries = 0;
    this.heard = 0;
    this.socket = null;
    setInterval(() => this.look(), LOOK);
    this.connect();
  }

  connect() {
    const socket = new WebSocket(liveAddress());
    this.socket = socket;
    this.heard = performance.now();
    socket.onmessage = (message) => {
      if (socket !== this.socket) return;
      this.heard = performance.now();
      this.tries = 0;
      this.on.state("live");
      this.on.event(JSON.parse(message.data));
    };
    socket.onclose = (event) => {
      if (socket !== this.socket) return;
      if (event.code !== NOT_GOOD) return this.lost();
      this.socket = null;
      this.on.state("signed out");
    };
  }

  look() {
    if (this.socket && performance.now() - this.heard > SILENCE) this.lost();
  }

  lost() {
    const socket = this.socket;
    this.socket = null;
    socket.onmessage = socket.onclose = null;
    socket.close();
    this.on.state("lost");
    setTimeout(() => this.again(), WAIT[Math.min(this.tries++, WAIT.length - 1)]);
  }

  async again() {
    try {
      await get("status", { signal: AbortSignal.timeout(2000) });
    } catch (error) {
      // 429: the station never delays a valid token, so this one is not valid.
      if (error.status === 401 || error.status === 429) return this.on.state("signed out", error);
    }
    return this.connect();
  }
}

// A station that is not there: what the page asks is kept in `sent`, and answered from `answers`. Its clock stands still.

const ROOT = "/api/v1/";

/** "METHOD path" → answer; an answer with `refused` is an error of that status; "held" is one that `go` gives later. */
window.answers = {};
window.sent = [];
window.held = [];
window.sockets = [];

window.fetch = async (address, how = {}) => {
  const url = new URL(address, location.href);
  const path = decodeURIComponent(url.pathname.slice(ROOT.length) + url.search);
  const octets = how.body instanceof ArrayBuffer;
  const body = octets ? `${how.body.byteLength} octets` : how.body === undefined ? null : JSON.parse(how.body);
  const entry = { method: how.method, path, body };
  if (how.headers?.["If-Match"]) entry.match = how.headers["If-Match"];
  if (octets) entry.kind = how.headers["Content-Type"];
  if (how.keepalive) entry.keepalive = true;
  window.sent.push(entry);
  const find = () => window.answers[`${how.method} ${path}`] ?? window.answers[`${how.method} ${path.split("?")[0]}`] ?? {};
  let answer = find();
  if (answer === "held") answer = await new Promise((go) => window.held.push((late) => go(late ?? find())));
  how.signal?.throwIfAborted();
  if (answer === "cut") throw new TypeError("Failed to fetch");
  const { refused, tag, ...words } = answer;
  const text = refused ? { error: words } : words;
  // no Response: its body comes at a time that nobody can wait for
  return { ok: !refused, status: refused ?? 200, headers: { get: () => tag ?? null }, json: async () => structuredClone(text) };
};

window.WebSocket = class {
  static OPEN = 1;

  constructor(address) {
    this.address = String(address);
    this.readyState = 1;
    this.lines = [];
    window.sockets.push(this);
  }

  send(line) {
    this.lines.push(JSON.parse(line));
  }

  close() {
    this.readyState = 3;
  }

  tell(message) {
    this.onmessage?.({ data: JSON.stringify(message) });
  }

  end(code, reason = "") {
    this.readyState = 3;
    this.onclose?.({ code, reason });
  }
};

// The API of the base station. Every refusal becomes a Refusal with cause and cure.

const ROOT = new URL("api/v1/", document.baseURI);
const PATIENCE = 60000; // ms; what waits for a person answers at once and is followed by events

/** What the station, or the way to it, said no to. */
export class Refusal extends Error {
  constructor(status, code, message, hint) {
    super(message);
    this.status = status;
    this.code = code;
    this.hint = hint ?? "";
  }
}

async function ask(method, path, body, { signal, keepalive, match, patience = PATIENCE } = {}) {
  const limit = AbortSignal.timeout(patience);
  const kind = body instanceof ArrayBuffer ? "application/octet-stream" : "application/json";
  let answer;
  try {
    answer = await fetch(new URL(path, ROOT), {
      method,
      keepalive: keepalive ?? false,
      credentials: "same-origin",
      cache: "no-store",
      headers: { ...(body !== undefined && { "Content-Type": kind }), ...(match && { "If-Match": match }) },
      body: body === undefined || body instanceof ArrayBuffer ? body : JSON.stringify(body),
      signal: signal ? AbortSignal.any([signal, limit]) : limit,
    });
  } catch (error) {
    if (signal?.aborted) throw error;
    throw new Refusal(0, "unreachable", "The base station is not responding.", "Is `teds-provision ncap run` still running?");
  }
  const said = await answer.json().catch(() => null);
  const tag = answer.headers.get("ETag"); // of the datasheet that was shown: a write is for that one alone
  if (answer.ok) return tag ? { ...said, tag } : (said ?? {});
  const why = said?.error ?? {};
  throw new Refusal(answer.status, why.code ?? String(answer.status), why.message ?? `Refused (${answer.status}).`, why.hint);
}

const at = (...parts) => parts.map(encodeURIComponent).join("/");

export const get = (path, options) => ask("GET", path, undefined, options);
export const post = (path, body = {}, options) => ask("POST", path, body, options);
export const send = (path, octets, options) => ask("POST", path, octets, options);
export const change = (path, body, options) => ask("PUT", path, body, options);
export const remove = (path) => ask("DELETE", path, {});

export const paths = {
  node: (uuid) => at("nodes", uuid),
  past: (uuid) => `${at("nodes", uuid)}/past`,
  teds: (uuid) => `${at("nodes", uuid)}/teds`,
  locate: (uuid) => `${at("nodes", uuid)}/locate`,
  provision: (uuid) => `${at("nodes", uuid)}/provision`,
  channel: (uuid, number) => `${at("nodes", uuid)}/channels/${number}`,
  group: (name) => at("groups", name),
  measurement: (id) => at("measurements", id),
  update: (id) => at("updates", id),
  virtual: (uuid) => at("virtual", uuid),
};

function socketAt(path) {
  const address = new URL(path, ROOT);
  address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
  return address;
}

/** Address of the WebSocket. */
export const liveAddress = () => socketAt("live");

/** Address at which a simulation feeds a virtual transducer. */
export const sourceAddress = (uuid) => socketAt(`${at("virtual", uuid)}/source`);

// The API of the base station. Every refusal becomes a Refusal with cause and remedy.

const ROOT = new URL("api/v1/", document.baseURI);
const PATIENCE = 60000; // ms; requests that wait for a user are answered at once, and events follow

/** A refusal by the station, or a failed connection. */
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
  const tag = answer.headers.get("ETag"); // of the shown datasheet: a write applies only to that one
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

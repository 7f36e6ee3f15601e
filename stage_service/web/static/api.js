// Requests to the API: JSON bodies; problem documents become errors.

import { local } from "./dom.js";

export class Problem extends Error {
  constructor(status, data) {
    super(local(data.detail ?? data.title ?? `HTTP ${status}`));
    this.status = status;
    this.kind = String(data.type ?? "").split("#")[1] ?? "";
    this.data = data;
  }
}

/** Where the service is: "/", or a proxy's path prefix. Paths below start with "/" and are resolved against it. */
export const BASE = new URL(".", location).pathname;
/** The name of a stored value, because services with other prefixes share the browser's storage. */
export const stored = (name) => (BASE === "/" ? name : `${name} ${BASE}`);

/** The lease that this page holds: {token, holder}; a reload keeps it. */
export const own = {
  get lease() { return JSON.parse(sessionStorage.getItem(stored("lease")) ?? "null"); },
  set lease(lease) {
    if (lease) sessionStorage.setItem(stored("lease"), JSON.stringify(lease));
    else sessionStorage.removeItem(stored("lease"));
  },
};

/** "contact": data arrived from the service; "logged out": the login has ended. A browser opens six connections to a
 * host. Before a blackout, "yield" aborts images and their figures, "yield all" every GET and the event stream, so that
 * one connection is free; "yielded": they may be requested again. */
export const service = new EventTarget();
export const emit = (kind) => service.dispatchEvent(new Event(kind));
const PATIENCE_MS = 30_000;

const yielding = { "yield": new AbortController(), "yield all": new AbortController() };
for (const kind of Object.keys(yielding)) {
  service.addEventListener(kind, () => {
    yielding[kind].abort(new Error("aborted: a blackout had priority"));
    yielding[kind] = new AbortController();
  });
}

/** `request("POST /captures", {plan})`. Raises `Problem`, or `TypeError` if the service does not respond.
 *
 * `more`: `signal` aborts it; `yields`: "yield" aborts it, too; `patience`: timeout in ms; `headers`: further headers. */
export async function request(what, body, more = {}) {
  const [method, path] = what.split(" ");
  const lease = own.lease;
  const signals = [AbortSignal.timeout(more.patience ?? PATIENCE_MS)];
  if (more.signal) signals.push(more.signal);
  if (method === "GET") signals.push(yielding[more.yields ? "yield" : "yield all"].signal);
  const response = await fetch(`.${path}`, {
    method,
    headers: { ...(lease ? { "Hairstage-Lease": lease.token } : {}), ...(body === undefined ? {} : { "content-type": "application/json" }), ...more.headers },
    body: body === undefined ? undefined : JSON.stringify(body),
    credentials: "same-origin",
    cache: "no-store",
    priority: more.priority ?? "auto",
    signal: AbortSignal.any(signals),
  });
  const json = (response.headers.get("content-type") ?? "").includes("json");
  const data = json ? await response.json() : null;
  if (json) emit("contact"); // not for a proxy's error page
  if (response.ok) return data;
  if (response.status === 401 && what !== "POST /login") emit("logged out");
  throw new Problem(response.status, data ?? {});
}

/** The path of a capture. */
export const captureAt = (id) => `/captures/${encodeURIComponent(id)}`;
export const get = (path, more) => request(`GET ${path}`, undefined, more);

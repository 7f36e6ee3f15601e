// Requests to the API: JSON, problems as errors.

import { local } from "./dom.js";

export class Problem extends Error {
  constructor(status, data) {
    super(local(data.detail ?? data.title ?? `HTTP ${status}`));
    this.status = status;
    this.kind = String(data.type ?? "").split("#")[1] ?? "";
    this.data = data;
  }
}

/** The lease that this page holds: {token, holder}; a page that is loaded again has it still. */
export const own = {
  get lease() { return JSON.parse(sessionStorage.getItem("lease") ?? "null"); },
  set lease(lease) {
    if (lease) sessionStorage.setItem("lease", JSON.stringify(lease));
    else sessionStorage.removeItem("lease");
  },
};

/** "word": the service has sent something; "over": nobody is logged in any more. A browser has six connections to a
 * host: "yield" gives up pictures and their figures, so that a blackout has one, "yield all" every GET and the events;
 * "yielded": all of it may be requested again, once what a blackout has ended was read. */
export const service = new EventTarget();
export const tell = (kind) => service.dispatchEvent(new Event(kind));
const PATIENCE_MS = 30_000;

const yielding = { "yield": new AbortController(), "yield all": new AbortController() };
for (const kind of Object.keys(yielding)) {
  service.addEventListener(kind, () => {
    yielding[kind].abort(new Error("not loaded: the blackout went first"));
    yielding[kind] = new AbortController();
  });
}

/** `ask("POST /captures", {plan})`. Raises `Problem`, or `TypeError` where nobody answers.
 *
 * `more`: `signal` ends it, so does "yield" where it `yields`; `patience` is in milliseconds, `headers` are sent besides. */
export async function ask(what, body, more = {}) {
  const [method, path] = what.split(" ");
  const lease = own.lease;
  const signals = [AbortSignal.timeout(more.patience ?? PATIENCE_MS)];
  if (more.signal) signals.push(more.signal);
  if (method === "GET") signals.push(yielding[more.yields ? "yield" : "yield all"].signal);
  const answer = await fetch(path, {
    method,
    headers: { ...(lease ? { "Hairstage-Lease": lease.token } : {}), ...(body === undefined ? {} : { "content-type": "application/json" }), ...more.headers },
    body: body === undefined ? undefined : JSON.stringify(body),
    credentials: "same-origin",
    cache: "no-store",
    priority: more.priority ?? "auto",
    signal: AbortSignal.any(signals),
  });
  const json = (answer.headers.get("content-type") ?? "").includes("json");
  const data = json ? await answer.json() : null;
  if (json) tell("word"); // a proxy's error page is none
  if (answer.ok) return data;
  if (answer.status === 401 && what !== "POST /login") tell("over");
  throw new Problem(answer.status, data ?? {});
}

/** The path of a capture. */
export const captureAt = (id) => `/captures/${encodeURIComponent(id)}`;
export const get = (path, more) => ask(`GET ${path}`, undefined, more);

// The API: JSON in and out, problems as errors, in the name of whoever has logged in.

export class Problem extends Error {
  constructor(status, data) {
    super(data.detail ?? data.title ?? `HTTP ${status}`);
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

export const login = new EventTarget();
const PATIENCE_MS = 30_000;

export function headers() {
  const lease = own.lease;
  return lease ? { "Hairstage-Lease": lease.token } : {};
}

/** `ask("POST /captures", {plan})`. Raises `Problem`, or `TypeError` where nobody answers. */
export async function ask(what, body, more = {}) {
  const [method, path] = what.split(" ");
  const answer = await fetch(path, {
    method,
    headers: { ...headers(), ...(body === undefined ? {} : { "content-type": "application/json" }) },
    body: body === undefined ? undefined : JSON.stringify(body),
    credentials: "same-origin",
    cache: "no-store",
    signal: more.signal ?? AbortSignal.timeout(more.patience ?? PATIENCE_MS),
  });
  const data = (answer.headers.get("content-type") ?? "").includes("json") ? await answer.json() : null;
  if (answer.ok) return data;
  if (answer.status === 401 && what !== "POST /login") login.dispatchEvent(new Event("over"));
  throw new Problem(answer.status, data ?? {});
}

export const get = (path, more) => ask(`GET ${path}`, undefined, more);

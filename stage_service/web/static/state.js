// The state of the service: requested at the start, updated by events.

import { captureAt, get, own, request, service, stored } from "./api.js";
import { keepRight, pressed } from "./blackout.js";
import { clock, local } from "./dom.js";
import { follow } from "./stream.js";

export const S = {
  loggedOut: false, // no login: the page has no state and sends no requests
  connected: null, // null: not yet; false: the connection is lost
  contactAt: null, // when data last arrived from the service (ms)
  polling: null, // why the service refuses the event stream; the page then polls every second
  problem: null, // why the first requests failed
  who: null,
  rig: null,
  health: null,
  capture: null, // the running one, else the last one
  failed: null, // a failed capture, until it is dismissed
  missing: [], // frames of this capture that were shot again or given up
  lease: { holder: null, expires: null },
  queue: { held: null, hold: null, waits_for: null, waiting: [] },
  jobs: null,
  jobsProblem: null,
};

const listeners = new Set();
const SOON_MS = 30;
const AGAIN_MS = 1000; // before a failed request is repeated
const CALM_MS = 250; // progress events arrive five times a second; redraw less often
let due = 0; // time of the next redraw; 0: none
let drawn = 0;
let timer = 0;

/** Call `fn()` soon after a change; after progress alone, four times a second. Returns a function that removes it. */
export function onChange(fn) {
  listeners.add(fn);
  return () => listeners.delete(fn);
}

export function changed(calm = false) {
  const now = performance.now();
  const at = Math.max(now + SOON_MS, calm ? drawn + CALM_MS : 0);
  if (due && due <= at) return;
  due = at;
  clearTimeout(timer);
  // Not requestAnimationFrame: a covered window must show an alarm in its title.
  timer = setTimeout(() => {
    [due, drawn] = [0, performance.now()];
    for (const fn of listeners) fn();
  }, at - now);
}

const events = new EventTarget(); // of the service, by kind

/** Call `fn(event)` for these kinds of events. Returns a function that removes it. */
export function onEvents(kinds, fn) {
  for (const kind of kinds) events.addEventListener(kind, fn);
  return () => kinds.forEach((kind) => events.removeEventListener(kind, fn));
}

const SILENT_S = 2.5; // the service sends data every 1 to 1.5 s
const LONGEST_S = 1.5;

service.addEventListener("contact", () => { S.contactAt = Date.now(); });

/** How long no data has arrived: {since, clock, seconds}; null: the connection is alive. */
export function silence() {
  if (S.loggedOut || S.contactAt === null) return null;
  const seconds = Math.max(0, (Date.now() - S.contactAt) / 1000);
  if (S.connected !== false && seconds < SILENT_S) return null;
  return { since: S.contactAt, clock: clock(S.contactAt), seconds: Math.floor(seconds) };
}

/** Timeout of the light bank's watchdog, as this browser last read it; null: no watchdog; undefined: never read. */
function watchdogSeconds() {
  const kept = localStorage.getItem(stored("watchdog_s"));
  return S.rig?.watchdog_s !== undefined ? S.rig.watchdog_s : kept === null ? undefined : JSON.parse(kept);
}

/** The effect of the light bank's watchdog if the service has stopped. */
export function watchdogSentence(silent = null) {
  const s = watchdogSeconds();
  if (s === undefined) return "If the service has stopped, the light bank's watchdog switches the lamps off, provided that the bank has one.";
  if (s === null) return "This light bank has no watchdog: lamps that are lit stay lit.";
  const rule = `the light bank's watchdog switches the lamps off ${s} s after the service's last heartbeat`;
  if (!silent) return `If the service has stopped, ${rule}.`;
  return `If the service has stopped, ${rule}: by ${clock(silent.since + 1000 * (s + LONGEST_S))}.`;
}

export const busy = () => S.capture !== null && S.capture.state !== "done";
export const mine = () => own.lease !== null && S.lease.holder !== null && own.lease.holder === S.lease.holder;
/** Why no lamp may be lit now; null: one may. */
export const unlit = () => (S.health?.latch ? "UNSAFE: no lamp may be lit before a blackout is read back dark" : null);

/** Why this page may not steer now; null: it may. */
export function refused() {
  if (silence()) return "the service does not respond";
  if (S.who && !S.who.scopes.includes("steer")) return "your token lacks the scope steer";
  if (S.lease.holder !== null && !mine()) return `${S.lease.holder} steers the stage until ${clock(S.lease.expires)}`;
  return null;
}

const under = new Map();
/** One request of a kind at a time; a call during it causes one more. */
async function fresh(name, path, take) {
  const before = under.get(name);
  if (before) { before.again = true; return before.promise; }
  const entry = { again: false };
  entry.promise = (async () => {
    try {
      do {
        entry.again = false;
        const found = await get(path);
        if (entry.again) continue; // outdated by an event
        take(found);
        changed();
      } while (entry.again);
    } finally {
      under.delete(name);
    }
  })();
  under.set(name, entry);
  return entry.promise;
}

const SNAPSHOT = "snapshot"; // listed as a capture only while it is exposed

export const load = {
  rig: () => fresh("rig", "/rig", (x) => {
    S.rig = x;
    localStorage.setItem(stored("watchdog_s"), JSON.stringify(x.watchdog_s ?? null));
  }),
  health: () => fresh("health", "/health", (x) => {
    const latch = x.latch && { ...x.latch, detail: local(x.latch.detail) };
    S.health = { ...x, latch, lamps_detail: local(x.lamps_detail), problems: x.problems.map(local) };
  }),
  lease: () => fresh("lease", "/lease", (x) => { S.lease = x; }),
  queue: () => fresh("queue", "/queue", (x) => { S.queue = { ...x, held: x.held && local(x.held), waits_for: x.waits_for && local(x.waits_for) }; }),
  jobs: () => fresh("jobs", "/jobs?limit=100", (x) => { S.jobs = x; S.jobsProblem = null; })
    .catch((error) => { S.jobsProblem = error.message; changed(); }),
  capture: (id) => fresh(`capture ${id}`, captureAt(id), takeCapture),
  /** The running capture, which need not be the newest; else the newest. */
  now: async () => {
    await load.health();
    const going = S.health.capture;
    if (going === null || going === SNAPSHOT) await fresh("newest", "/captures?limit=1", takeNewest);
    if (going !== null) await load.capture(going);
  },
};

/** Load parts of the state; the next event repeats a failed request. */
const reload = (...parts) => parts.forEach((part) => load[part]().catch(() => {}));

function takeCapture(found) {
  const status = found.error ? { ...found, error: local(found.error) } : found;
  if (status.id === SNAPSHOT && status.state === "done") {
    if (S.capture?.id === SNAPSHOT) reload("now");
    return;
  }
  if (S.capture?.id !== status.id) {
    if (S.capture && S.capture.id !== SNAPSHOT && status.id < S.capture.id && status.state === "done") return; // an older one
    S.missing = [];
    if (S.capture?.id !== SNAPSHOT) S.failed = null;
  } else resumed(status.state);
  S.capture = status;
  if (status.state !== "done") S.failed = null;
}

function takeNewest([newest]) {
  if (S.capture?.id === SNAPSHOT && !newest) S.capture = null;
  else if (S.capture && S.capture.id !== SNAPSHOT && !(newest?.id >= S.capture.id)) gone(); // removed meanwhile
  if (newest) takeCapture(newest);
}

/** The displayed capture was removed. */
function gone() {
  S.capture = S.failed = null;
  S.missing = [];
}

/** A resumed capture repeats its missing frames. */
function resumed(state) {
  if (S.capture.state === "done" && state !== "done") S.missing = [];
}

function onEvent(kind, data) {
  const [about] = kind.split(".");
  if (kind === "capture.progress") {
    const { id, ...progress } = data;
    if (S.capture?.id === id && S.capture.state !== "done") {
      S.capture = { ...S.capture, step: progress.step, progress };
    } else load.capture(id).catch(() => {});
  } else if (kind === "capture.state") {
    if (S.capture?.id === data.id) {
      resumed(data.state);
      S.capture = { ...S.capture, state: data.state, outcome: data.state === "done" ? data.outcome : null, error: data.error };
    }
    if (data.state === "done" && data.outcome === "failed") S.failed = { id: data.id, error: data.error };
    load.capture(data.id).catch(() => {});
    reload("health", "queue");
  } else if (kind === "capture.over") { // the next one may start
    load.capture(data.id).catch(() => {});
    reload("health", "queue");
  } else if (kind === "capture.removed") {
    if (S.failed?.id === data.id) S.failed = null;
    if (S.capture?.id === data.id) {
      gone();
      reload("now");
    }
  } else if (kind === "capture.restored" || kind === "captures.read") {
    if (S.failed === null) reload("now"); // else the failed one stays until it is dismissed
  } else if (kind === "capture.frame_missing") {
    S.missing = [{ ...data, at: new Date().toISOString() }, ...S.missing].slice(0, 200);
  } else if (kind === "stage.lease") {
    S.lease = data;
    reload("lease"); // a request that is under way may return an older one
  } else if (about === "stage") {
    reload("health", "queue");
  } else if (about === "queue") {
    reload("queue");
  } else if (kind === "job.progress") {
    const { job, ...progress } = data;
    const known = S.jobs?.find((x) => x.id === job);
    if (known) known.progress = progress;
  } else if (about === "job") load.jobs();
  events.dispatchEvent(new CustomEvent(kind, { detail: data }));
  if (kind !== "capture.step") changed(kind === "capture.progress" || kind === "job.progress");
}

let line = 0; // number of the current connection, or of the one lost last
const down = () => { line++; S.connected = false; changed(); };

/** Request the whole state: at the start and after each reconnection. */
async function all(mine) {
  const version = S.health?.version;
  await Promise.all([load.rig(), load.lease(), load.queue(), load.now(), load.jobs()]);
  if (version && S.health.version !== version) location.reload(); // the service was updated: load its console
  if (S.capture?.state === "done" && S.capture.outcome === "failed" && S.failed === null
      && sessionStorage.getItem(stored("dismissed")) !== S.capture.id) S.failed = { id: S.capture.id, error: S.capture.error };
  await keepLease();
  if (mine !== line) return;
  S.connected = true;
  S.polling = S.problem = null;
  changed();
  events.dispatchEvent(new Event("fresh"));
}

/** The service refuses the event stream (`why`): poll the state. */
async function poll(why) {
  const mine = ++line;
  const shown = () => JSON.stringify([S.connected, S.capture?.id, S.capture?.state, S.capture?.outcome]);
  const before = shown();
  try {
    await Promise.all([load.lease(), load.queue(), load.now(), S.rig ? null : load.rig(), S.jobs ? null : load.jobs()]);
  } catch (error) {
    S.problem = error.message;
    if (mine === line && error.status !== 401) down();
    return;
  }
  if (mine !== line) return;
  Object.assign(S, { connected: true, polling: why, problem: null });
  changed();
  if (shown() !== before) events.dispatchEvent(new Event("fresh"));
}

/** Request the state until it is complete; a failed request does not close the connection. */
async function up() {
  const mine = ++line;
  while (mine === line) {
    try {
      return await all(mine);
    } catch (error) {
      if (error.status === 401) return undefined;
      S.problem = error.message;
      changed();
      await new Promise((later) => setTimeout(later, AGAIN_MS));
    }
  }
  return undefined;
}

/** Start; raises without a login. */
export async function begin() {
  S.who = await get("/login");
  keepRight(S.who);
  follow({ event: onEvent, up, down, refused: poll });
  setInterval(() => { if (S.connected && !S.loggedOut && !document.hidden) reload("health"); }, 30_000); // for the free disk space
}

let aged = false;
setInterval(() => { // texts that show elapsed time
  const ages = silence() !== null || Boolean(pressed?.going);
  if (ages || aged) changed();
  aged = ages;
}, CALM_MS);

// The lease is renewed while this page holds it.
const LEASE_S = 150;

export async function takeLease(holder) {
  if (mine()) return;
  own.lease = null;
  own.lease = await request("POST /lease", { holder, seconds: LEASE_S });
  S.lease = { holder: own.lease.holder, expires: own.lease.expires };
  changed();
}

export async function releaseLease() {
  if (!own.lease) return;
  try {
    await request("DELETE /lease");
  } finally {
    own.lease = null;
    await load.lease();
  }
}

async function keepLease() {
  if (!own.lease) return;
  try {
    own.lease = await request("PATCH /lease", { seconds: LEASE_S });
    S.lease = { holder: own.lease.holder, expires: own.lease.expires };
  } catch (error) {
    if (error.kind === "no-lease") own.lease = null;
    await load.lease().catch(() => {});
  }
  changed();
}

setInterval(() => { if (own.lease && S.connected && !S.loggedOut) keepLease(); }, 50_000);
setInterval(() => { // no event reports its end
  if (!S.loggedOut && S.lease.expires && new Date(S.lease.expires) < new Date()) reload("lease");
}, 5_000);

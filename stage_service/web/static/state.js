// The state of the service, requested once and updated by events.

import { ask, captureAt, get, own, service } from "./ask.js";
import { keepRight, pressed } from "./blackout.js";
import { clock, local } from "./dom.js";
import { follow } from "./stream.js";

export const S = {
  out: false, // nobody is logged in: nothing is known, and nothing is requested
  connected: null, // null: not yet; false: events and answers have stopped
  heardAt: null, // when the service last sent anything (ms)
  polling: null, // why the service refuses events to this page, which then asks every second
  problem: null, // why what the page needs first has not been answered
  who: null,
  rig: null,
  health: null,
  capture: null, // the one that runs, else the last one
  failed: null, // a capture that failed, until somebody has seen it
  missing: [], // frames of this capture that were shot again or given up
  lease: { holder: null, expires: null },
  queue: { held: null, hold: null, waits_for: null, waiting: [] },
  jobs: null,
  jobsProblem: null,
};

const listeners = new Set();
const SOON_MS = 30;
const AGAIN_MS = 1000; // after a question that got no answer
const CALM_MS = 250; // a capture tells its progress five times a second: drawing that is work, for nobody's eye
let due = 0; // when it is drawn next; 0: nothing is to be
let drawn = 0;
let timer = 0;

/** `fn()` is called soon after a change; where only progress was made, four times a second. Returns what
 * ends that. */
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
  // Not by requestAnimationFrame alone: a window that is covered must still show an alarm in its title.
  timer = setTimeout(() => {
    [due, drawn] = [0, performance.now()];
    for (const fn of listeners) fn();
  }, at - now);
}

export const events = new EventTarget(); // each of the service's, by its kind

const SILENT_S = 2.5; // a service sends something every 1 to 1.5 s
const LONGEST_S = 1.5;

service.addEventListener("word", () => { S.heardAt = Date.now(); });

/** Since when nothing has come from the service: {since, clock, seconds}; null: it was heard just now. */
export function silence() {
  if (S.out || S.heardAt === null) return null;
  const seconds = Math.max(0, (Date.now() - S.heardAt) / 1000);
  if (S.connected !== false && seconds < SILENT_S) return null;
  return { since: S.heardAt, clock: clock(S.heardAt), seconds: Math.floor(seconds) };
}

/** Seconds after the service's last heartbeat at which the light bank puts its lamps off by itself, as this page
 * last read it; null: it has no watchdog; undefined: this browser has never read it. */
export function watchdogSeconds() {
  const kept = localStorage.getItem("watchdog_s");
  return S.rig?.watchdog_s !== undefined ? S.rig.watchdog_s : kept === null ? undefined : JSON.parse(kept);
}

/** What a light bank's watchdog does about a service that has stopped, with its seconds. */
export function watchdogSentence(silent = null) {
  const s = watchdogSeconds();
  if (s === undefined) return "If the service has stopped, the light bank's watchdog puts the lamps off, where the bank has one.";
  if (s === null) return "This light bank has no watchdog: lamps that are lit stay lit.";
  const rule = `the light bank's watchdog puts the lamps off ${s} s after the service's last heartbeat`;
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
/** One question of a kind at a time, and another after it where it was asked for meanwhile. */
async function fresh(name, path, take) {
  const before = under.get(name);
  if (before) { before.again = true; return before.promise; }
  const entry = { again: false };
  entry.promise = (async () => {
    try {
      do {
        entry.again = false;
        const found = await get(path);
        if (entry.again) continue; // something has happened since it was asked for
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

const SNAPSHOT = "snapshot"; // it is no capture but while it is taken

export const load = {
  rig: () => fresh("rig", "/rig", (x) => {
    S.rig = x;
    localStorage.setItem("watchdog_s", JSON.stringify(x.watchdog_s ?? null));
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
  /** The capture that runs, which need not be the newest, else that. */
  now: async () => {
    await load.health();
    const going = S.health.capture;
    if (going === null || going === SNAPSHOT) await fresh("newest", "/captures?limit=1", takeNewest);
    if (going !== null) await load.capture(going);
  },
};

function takeCapture(found) {
  const status = found.error ? { ...found, error: local(found.error) } : found;
  if (status.id === SNAPSHOT && status.state === "done") {
    if (S.capture?.id === SNAPSHOT) load.now().catch(() => {});
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

/** The capture that is shown is there no more. */
function gone() {
  S.capture = S.failed = null;
  S.missing = [];
}

/** What the capture lacked is shot now. */
function resumed(state) {
  if (S.capture.state === "done" && state !== "done") S.missing = [];
}

function heard(kind, data) {
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
    load.health().catch(() => {});
    load.queue().catch(() => {});
  } else if (kind === "capture.over") { // from now on another may begin
    load.capture(data.id).catch(() => {});
    load.health().catch(() => {});
    load.queue().catch(() => {});
  } else if (kind === "capture.removed") {
    if (S.failed?.id === data.id) S.failed = null;
    if (S.capture?.id === data.id) {
      gone();
      load.now().catch(() => {});
    }
  } else if (kind === "capture.restored" || kind === "captures.read") {
    if (S.failed === null) load.now().catch(() => {}); // else what failed stays until it is seen
  } else if (kind === "capture.frame_missing") {
    S.missing = [{ ...data, at: new Date().toISOString() }, ...S.missing].slice(0, 200);
  } else if (kind === "stage.lease") {
    S.lease = data;
  } else if (about === "stage") {
    load.health().catch(() => {});
    load.queue().catch(() => {});
  } else if (about === "queue") {
    load.queue().catch(() => {});
  } else if (kind === "job.progress") {
    const { job, ...progress } = data;
    const known = S.jobs?.find((x) => x.id === job);
    if (known) known.progress = progress;
  } else if (about === "job") load.jobs();
  events.dispatchEvent(new CustomEvent(kind, { detail: data }));
  if (kind !== "capture.step") changed(kind === "capture.progress" || kind === "job.progress");
}

let line = 0; // which of the lines to the service is the one that holds, or was lost last
const down = () => { line++; S.connected = false; changed(); };

/** Ask for everything: at the start, and whenever the line was lost. */
async function all(mine) {
  const version = S.health?.version;
  await Promise.all([load.rig(), load.lease(), load.queue(), load.now(), load.jobs()]);
  if (version && S.health.version !== version) location.reload(); // another console came with it
  if (S.capture?.state === "done" && S.capture.outcome === "failed" && S.failed === null
      && sessionStorage.getItem("seen") !== S.capture.id) S.failed = { id: S.capture.id, error: S.capture.error };
  await keepLease();
  if (mine !== line) return;
  S.connected = true;
  S.polling = S.problem = null;
  changed();
  events.dispatchEvent(new Event("fresh"));
}

/** Where the service refuses events, `why`: ask for what they would have told. */
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

/** Ask until all is answered: one lost question does not end the line, which would have it asked again. */
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

/** Begin; raises where nobody is logged in. */
export async function begin() {
  S.who = await get("/login");
  keepRight(S.who);
  follow({ event: heard, up, down, refused: poll });
  setInterval(() => { if (S.connected && !S.out && !document.hidden) load.health().catch(() => {}); }, 30_000); // the disk
}

let aged = false;
setInterval(() => { // what is drawn from the time since something happened
  const ages = silence() !== null || Boolean(pressed?.going);
  if (ages || aged) changed();
  aged = ages;
}, CALM_MS);

// The lease, for as long as a page holds it.
const LEASE_S = 150;

export async function takeLease(holder) {
  if (mine()) return;
  own.lease = null;
  own.lease = await ask("POST /lease", { holder, seconds: LEASE_S });
  S.lease = { holder: own.lease.holder, expires: own.lease.expires };
  changed();
}

export async function releaseLease() {
  if (!own.lease) return;
  try {
    await ask("DELETE /lease");
  } finally {
    own.lease = null;
    await load.lease();
  }
}

async function keepLease() {
  if (!own.lease) return;
  try {
    own.lease = await ask("PATCH /lease", { seconds: LEASE_S });
    S.lease = { holder: own.lease.holder, expires: own.lease.expires };
  } catch (error) {
    if (error.kind === "no-lease") own.lease = null;
    await load.lease().catch(() => {});
  }
  changed();
}

setInterval(() => { if (own.lease && S.connected && !S.out) keepLease(); }, 50_000);
setInterval(() => { // no event says that one has run out
  if (!S.out && S.lease.expires && new Date(S.lease.expires) < new Date()) load.lease().catch(() => {});
}, 5_000);

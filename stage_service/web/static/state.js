// What the page knows of the service: asked for once, then kept by events.

import { ask, get, own } from "./ask.js";
import { follow } from "./stream.js";

export const S = {
  connected: null, // null: not yet; false: since `lostAt`
  lostAt: null,
  who: null,
  rig: null,
  health: null,
  capture: null, // the one that runs, else the last one
  failed: null, // a capture that failed, until somebody has seen it
  missing: [], // frames of this capture that were shot again or given up
  lease: { holder: null, expires: null },
  queue: { held: null, waits_for: null, waiting: [] },
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

export const busy = () => S.capture !== null && S.capture.state !== "done";
export const mine = () => own.lease !== null && S.lease.holder !== null && own.lease.holder === S.lease.holder;
/** Why this page may not steer now; null: it may. */
export function refused() {
  if (S.connected === false) return "no connection to the service";
  if (S.who && !S.who.scopes.includes("steer")) return "your token does not open steering";
  if (S.lease.holder !== null && !mine()) return `${S.lease.holder} steers the stage until ${new Date(S.lease.expires).toLocaleTimeString("en-GB")}`;
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
  rig: () => fresh("rig", "/rig", (x) => { S.rig = x; }),
  health: () => fresh("health", "/health", (x) => { S.health = x; }),
  lease: () => fresh("lease", "/lease", (x) => { S.lease = x; }),
  queue: () => fresh("queue", "/queue", (x) => { S.queue = x; }),
  jobs: () => fresh("jobs", "/jobs?limit=100", (x) => { S.jobs = x; S.jobsProblem = null; })
    .catch((error) => { S.jobsProblem = error.message; changed(); }),
  capture: (id) => fresh(`capture ${id}`, `/captures/${id}`, takeCapture),
  /** The capture that runs, which need not be the newest, else that. */
  now: async () => {
    await load.health();
    const going = S.health.capture;
    if (going === null || going === SNAPSHOT) await fresh("newest", "/captures?limit=1", takeNewest);
    if (going !== null) await load.capture(going);
  },
};

function takeCapture(status) {
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
  changed();
  events.dispatchEvent(new Event("fresh"));
}

/** Ask until all is answered: one lost question does not end the line, which would have it asked again. */
async function up() {
  const mine = ++line;
  while (mine === line) {
    try {
      return await all(mine);
    } catch (error) {
      if (error.status === 401) return undefined;
      await new Promise((later) => setTimeout(later, AGAIN_MS));
    }
  }
  return undefined;
}

/** Begin; raises where nobody is logged in. */
export async function begin() {
  S.who = await get("/login");
  const followed = follow({
    event: heard,
    up,
    down: () => {
      line++;
      if (S.connected !== false) S.lostAt = new Date().toISOString();
      S.connected = false;
      changed();
    },
  });
  setInterval(() => { if (S.connected && !document.hidden) load.health().catch(() => {}); }, 30_000); // the disk
  return followed;
}

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
    if (error.status) own.lease = null; // it is over; where nobody answers it may not be
    await load.lease().catch(() => {});
  }
  changed();
}

setInterval(() => { if (own.lease && S.connected) keepLease(); }, 50_000);
setInterval(() => { // one that ran out is told by nobody
  if (S.lease.expires && new Date(S.lease.expires) < new Date()) load.lease().catch(() => {});
}, 5_000);

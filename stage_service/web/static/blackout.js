// Blackout in every state of the page, repeated until the service responds.

import { emit, request, stored } from "./api.js";
import { local } from "./dom.js";

const PATIENCE_MS = 5000; // of the first attempt; a service responds to a blackout within 1 s
const MOST_PATIENCE_MS = 20_000; // few attempts queue up at a frozen service
const AGAIN_MS = 500;
const YIELD_MS = 1200; // a running service responds within this time
const TEMPORARY = [408, 429]; // and every 5xx; other refusals are final
const RIGHT = stored("blackout right");
const PRESSED = stored("blackout pressed");

/** The last press on this page: `at` (ms), `going` while the page sends it, `error` of the last failed attempt, `refused`
 * (the service's reason), `response` {at, safe, detail}. Null: not pressed, or dismissed. */
export let pressed = JSON.parse(sessionStorage.getItem(PRESSED) ?? "null");

/** The right to send Blackout without a login; null: this browser has none. */
export const right = () => localStorage.getItem(RIGHT);

/** The header with that right. A login with it is not delayed by failed logins from the same address. */
export const rightHeader = () => (right() ? { "Hairstage-Blackout": right() } : {});

/** Store the blackout right of a login's response. */
export function keepRight({ blackout: value }) {
  if (value) localStorage.setItem(RIGHT, value);
  else localStorage.removeItem(RIGHT);
}

let attempt = null; // the request in progress: {at (ms), abort}

/** Every lamp and projector off. Repeated until the service responds, across outages, restarts and reloads of the page;
 * a second press restarts an attempt without a response. */
export async function blackout() {
  if (pressed?.going) {
    if (attempt && Date.now() - attempt.at > YIELD_MS) attempt.abort.abort(new Error("pressed again"));
    return;
  }
  put({ at: Date.now(), going: true });
  await send();
}

/** Continue the blackout of the page before its reload. */
export function resume() {
  if (pressed?.going) send();
}

/** After a login: repeat a blackout that was refused without one. */
export function resend() {
  if (!pressed?.refused) return;
  put({ at: pressed.at, going: true });
  send();
}

export const dismiss = () => put(null);

function put(next) {
  pressed = next;
  if (next === null || next.response) sessionStorage.removeItem(PRESSED);
  else sessionStorage.setItem(PRESSED, JSON.stringify(next));
  emit("pressed");
}

async function send() {
  emit("yield");
  for (let patience = PATIENCE_MS; ; patience = Math.min(2 * patience, MOST_PATIENCE_MS)) {
    const room = setTimeout(() => emit("yield all"), YIELD_MS);
    attempt = { at: Date.now(), abort: new AbortController() };
    try {
      const more = { signal: attempt.abort.signal, patience, priority: "high", headers: rightHeader() };
      const { safe, detail } = await request("POST /devices/blackout", undefined, more);
      put({ at: pressed.at, response: { at: Date.now(), safe, detail: local(detail) } });
      break;
    } catch (error) {
      if (error.status && error.status < 500 && !TEMPORARY.includes(error.status)) {
        put({ at: pressed.at, refused: { kind: error.kind, detail: error.message } });
        break;
      }
      put({ ...pressed, error: error.status ? error.message : null });
    } finally {
      clearTimeout(room);
    }
    await new Promise((later) => setTimeout(later, AGAIN_MS));
  }
}

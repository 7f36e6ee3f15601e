// Blackout in every state of the page, repeated until the service responds.

import { ask, service, tell } from "./ask.js";
import { local } from "./dom.js";

const PATIENCE_MS = 5000; // of the first try; the service answers a blackout within 1 s
const MOST_PATIENCE_MS = 20_000; // a frozen service finds all tries once it goes on: few
const AGAIN_MS = 500;
const YIELD_MS = 1200; // a service that answers has done so by then
const LATER = [408, 429]; // refusals of now, as any 5xx; all others stand
const RIGHT = "blackout right";
const PRESSED = "blackout pressed";

/** The last press of this page: `at` (ms), `going` while it is sent, `error` why the last try failed, `refused` the
 * service's reason, `answer` {at, safe, detail}. Null: none, or it was dismissed. */
export let pressed = JSON.parse(sessionStorage.getItem(PRESSED) ?? "null");

/** The right to send Blackout alone, without a login; null: this browser has none. */
export const right = () => localStorage.getItem(RIGHT);

/** The header that carries it: it darkens, and a login with it does not wait for others' wrong ones. */
export const rightHeader = () => (right() ? { "Hairstage-Blackout": right() } : {});

/** Keep the right that a login's answer has in `blackout`. */
export function keepRight({ blackout: value }) {
  if (value) localStorage.setItem(RIGHT, value);
  else localStorage.removeItem(RIGHT);
}

let tried = null; // the try under way: {at (ms), abort}

/** Every lamp and projector off. Sent until the service answers, over outages, restarts and reloads of the page;
 * pressed again, a try that is not answered is made anew. */
export async function blackout() {
  if (pressed?.going) {
    if (tried && Date.now() - tried.at > YIELD_MS) tried.abort.abort(new Error("pressed again"));
    return;
  }
  put({ at: Date.now(), going: true });
  await send();
}

/** What the page that was loaded here before was sending is sent on. */
export function resume() {
  if (pressed?.going) send();
}

/** Somebody has logged in: what was refused for want of that is sent now. */
export function resend() {
  if (!pressed?.refused) return;
  put({ at: pressed.at, going: true });
  send();
}

export const dismiss = () => put(null);

function put(next) {
  pressed = next;
  if (next === null || next.answer) sessionStorage.removeItem(PRESSED);
  else sessionStorage.setItem(PRESSED, JSON.stringify(next));
  tell("pressed");
}

async function send() {
  tell("yield");
  for (let patience = PATIENCE_MS; ; patience = Math.min(2 * patience, MOST_PATIENCE_MS)) {
    const room = setTimeout(() => tell("yield all"), YIELD_MS);
    tried = { at: Date.now(), abort: new AbortController() };
    try {
      const more = { signal: tried.abort.signal, patience, priority: "high", headers: rightHeader() };
      const { safe, detail } = await ask("POST /devices/blackout", undefined, more);
      put({ at: pressed.at, answer: { at: Date.now(), safe, detail: local(detail) } });
      break;
    } catch (error) {
      if (error.status && error.status < 500 && !LATER.includes(error.status)) {
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

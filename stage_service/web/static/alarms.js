// Alarms above every view, shown until their cause is removed.

import { attempt } from "./acts.js";
import { request, stored } from "./api.js";
import { dismiss, pressed, right } from "./blackout.js";
import { button, clock, h, keyed, setContent } from "./dom.js";
import { contradicts, lampWords } from "./lamps.js";
import { S, changed, load, silence, watchdogSentence } from "./state.js";

const STOP = "Press the wired emergency stop.";
const NO_RESPONSE_MS = 1500; // a running service responds within this time

/** Returns a function that updates the alarms in `box`; call it after each change. */
export function alarmBox(box) {
  return () => keyed(box, [refusal(), noResponse(), blackoutResult(), loggedOut(), silent(), polling(), ...(S.loggedOut ? [] : stage())].filter(Boolean), (x) => x.key, (x) => x.make());
}

/** An alarm. Screen readers skip the elapsed seconds of `counting`: they change every second. */
function alarm(kind, strong, ...rest) {
  const key = [kind, strong, ...rest.map((x) => x.textContent ?? x)].join("|");
  return { key, make: () => ({ element: h(`.alarm${kind}`, h("strong", strong, " "), rest) }) };
}

function counting(kind, strong, seconds, ...rest) {
  const key = [kind, strong, ...rest.map((x) => x.textContent ?? x)].join("|");
  return { key, seconds, make: () => {
    const count = h("span.n", { "aria-hidden": "true" });
    return { element: h(`.alarm${kind}`, h("strong", strong, " "), count, " ", rest), update: (x) => setContent(count, `${x.seconds()} s.`) };
  } };
}

const ago = (ms) => Math.floor((Date.now() - ms) / 1000);

function refusal() {
  const why = pressed?.refused;
  if (!why) return null;
  const unauthorized = why.kind === "unauthorized";
  return alarm("", unauthorized ? "Log in again. The stage was NOT darkened: press the wired emergency stop." : "The stage was NOT darkened: press the wired emergency stop.",
    `Blackout of ${clock(pressed.at)} was refused: ${unauthorized ? "this page is not logged in and has no blackout right. The page sends it again when you log in." : `${why.detail}.`} ${watchdogSentence()} `,
    button(unauthorized ? "do not send it again" : "dismiss", () => dismiss(), { kind: "quiet" }));
}

function noResponse() {
  if (!pressed?.going || Date.now() - pressed.at < NO_RESPONSE_MS) return null;
  return counting("", `Blackout of ${clock(pressed.at)} has had no response for`, () => ago(pressed.at),
    `${pressed.error ? `The service failed: ${pressed.error}. ` : ""}The page repeats it until the service responds. ${STOP}`,
    silence() ? "" : ` ${watchdogSentence()}`);
}

/** The result of this page's blackout, for a page without a login: it shows no other state of the stage. */
function blackoutResult() {
  if (!S.loggedOut || !pressed?.response) return null;
  const { at, safe, detail } = pressed.response;
  if (safe && contradicts(detail)) return alarm(".accepted", `Reported dark at ${clock(at)}.`, `Blackout of this page: ${detail}.`);
  if (safe) return alarm(".calm", `Dark, verified at ${clock(at)},`, "by the blackout of this page. Log in to see later events.");
  return alarm("", "UNSAFE: treat every lamp as lit.", `Blackout of ${clock(pressed.at)}, response at ${clock(at)}: ${detail} ${watchdogSentence()} ${STOP}`);
}

function loggedOut() {
  if (!S.loggedOut || pressed?.refused) return null;
  if (right()) return alarm(".accepted", S.who ? "Your login has ended." : "You are not logged in.", "The page shows no state of the stage. Blackout (F9) works without a login.");
  return alarm("", "This page cannot darken the stage.", `Blackout (F9) needs a browser that was logged in here before. Log in, or press the wired emergency stop. ${watchdogSentence()}`);
}

function silent() {
  const since = silence();
  if (!since || document.hidden) return null;
  return counting("", `No response from the service since ${since.clock}:`, () => silence()?.seconds ?? 0,
    `The stage may be lit, and the page shows the state of ${since.clock}. ${watchdogSentence(since)} If only the connection is lost, the service still controls the lamps. The page keeps trying.`);
}

function polling() {
  if (!S.polling) return null;
  return alarm(".accepted", "The service refuses live events to this page.", `Reason: ${S.polling}. The page requests the state every second instead. Abort and Blackout work.`);
}

function stage() {
  const { latch } = S.health ?? {};
  const { state, alarm: lamps } = lampWords(S.health);
  const known = latch ? unsafe(latch) : lamps ? alarm(["accepted", "doubted"].includes(state) ? ".accepted" : "", ...lamps.map((x) => x.trim())) : null;
  return [known, S.failed ? failed(latch) : null];
}

function failed(latch) {
  const { id, error } = S.failed;
  const why = latch ? (error ?? "").split("; blackout: ")[0] : error ?? "";
  return alarm("", `Capture ${id} failed.`, `${latch?.detail.includes(why) ? "The reason is above." : why} `, button("dismiss", () => {
    sessionStorage.setItem(stored("dismissed"), id);
    S.failed = null;
    changed();
  }, { kind: "quiet" }));
}

function unsafe(latch) {
  const why = () => h("p", h("strong", "UNSAFE: treat every lamp as lit."), ` Since ${clock(latch.since)}: ${latch.detail.replace(/^unknown, unsafe: /, "")}`);
  const key = `latch|${latch.since}|${latch.detail}|${latch.ended_by}`;
  if (latch.ended_by === "blackout") return { key, make: () => ({ element: h(".alarm.latch", why(), h("p", "The service lights no lamp until a blackout reads every lamp back dark. Stay out of the stage, cut the lamps' supply, remove the cause, then press ", h("b", "Blackout"), " (F9).")) }) };
  return { key, make: () => {
    const name = h("input", { name: "name", required: true, minlength: 2, placeholder: "your name", "aria-label": "your name" });
    const note = h("input", { name: "note", required: true, minlength: 4, placeholder: "what you observed", "aria-label": "what you observed" });
    return { element: h(".alarm.latch", why(), h("p", "This light bank cannot report whether its lamps are off. The service lights no lamp until a person has inspected the stage and confirms that it is dark:"),
      h("form.line", { onsubmit: (event) => {
        event.preventDefault();
        attempt(() => request("POST /devices/acknowledge", { name: name.value, note: note.value })).then(() => load.health());
      } }, name, note, h("button", "I looked: the lamps are off"))) };
  } };
}

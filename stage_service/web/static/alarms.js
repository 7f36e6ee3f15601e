// Alarms above every view, shown until their cause has gone.

import { attempt } from "./acts.js";
import { ask } from "./ask.js";
import { dismiss, pressed, right } from "./blackout.js";
import { button, clock, h, keyed, say } from "./dom.js";
import { contradicts, lampWords } from "./lamps.js";
import { S, changed, load, silence, watchdogSentence } from "./state.js";

const STOP = "Press the wired emergency stop.";
const UNANSWERED_MS = 1500; // a service that answers has done so by then

/** Keeps `box` as it should be; call the function that this returns after each change. */
export function alarmBox(box) {
  return () => keyed(box, [refusal(), unanswered(), answer(), loggedOut(), silent(), polling(), ...(S.out ? [] : stage())].filter(Boolean), (x) => x.key, (x) => x.make());
}

/** An alarm; the elapsed seconds are drawn and not read out, which would be once a second. */
function alarm(kind, strong, ...rest) {
  const key = [kind, strong, ...rest.map((x) => x.textContent ?? x)].join("|");
  return { key, make: () => ({ element: h(`.alarm${kind}`, h("strong", strong, " "), rest) }) };
}

function counting(kind, strong, seconds, ...rest) {
  const key = [kind, strong, ...rest.map((x) => x.textContent ?? x)].join("|");
  return { key, seconds, make: () => {
    const count = h("span.n", { "aria-hidden": "true" });
    return { element: h(`.alarm${kind}`, h("strong", strong, " "), count, " ", rest), tell: (x) => say(count, `${x.seconds()} s.`) };
  } };
}

const ago = (ms) => Math.floor((Date.now() - ms) / 1000);

function refusal() {
  const why = pressed?.refused;
  if (!why) return null;
  const login = why.kind === "unauthorized";
  return alarm("", login ? "Log in again. The stage was NOT darkened: press the wired emergency stop." : "The stage was NOT darkened: press the wired emergency stop.",
    `Blackout of ${clock(pressed.at)} was refused: ${login ? "this page is not logged in and has no blackout right. It is sent again as soon as you log in." : `${why.detail}.`} ${watchdogSentence()} `,
    button(login ? "do not send it again" : "dismiss", () => dismiss(), { kind: "quiet" }));
}

function unanswered() {
  if (!pressed?.going || Date.now() - pressed.at < UNANSWERED_MS) return null;
  return counting("", `Blackout of ${clock(pressed.at)} has had no response for`, () => ago(pressed.at),
    `${pressed.error ? `The service failed: ${pressed.error}. ` : ""}It is repeated until the service responds. ${STOP}`,
    silence() ? "" : ` ${watchdogSentence()}`);
}

/** To a page without a login, which is shown nothing else of the stage. */
function answer() {
  if (!S.out || !pressed?.answer) return null;
  const { at, safe, detail } = pressed.answer;
  if (safe && contradicts(detail)) return alarm(".accepted", `Reported dark at ${clock(at)}.`, `Blackout of this page: ${detail}.`);
  if (safe) return alarm(".calm", `Dark, verified at ${clock(at)},`, "by the blackout of this page. Log in to see later events.");
  return alarm("", "UNSAFE: treat every lamp as lit.", `Blackout of ${clock(pressed.at)}, response at ${clock(at)}: ${detail} ${watchdogSentence()} ${STOP}`);
}

function loggedOut() {
  if (!S.out || pressed?.refused) return null;
  if (right()) return alarm(".accepted", S.who ? "Your login has ended." : "You are not logged in.", "Nothing of the stage is shown. Blackout (F9) works without a login.");
  return alarm("", "This page cannot darken the stage.", `Blackout (F9) needs a browser that was logged in here before. Log in, or press the wired emergency stop. ${watchdogSentence()}`);
}

function silent() {
  const since = silence();
  if (!since || document.hidden) return null;
  return counting("", `No response from the service since ${since.clock}:`, () => silence()?.seconds ?? 0,
    `The stage may be lit, and the page shows the state of ${since.clock}. ${watchdogSentence(since)} If only the connection is lost, lamps stay as the service commands them. The page keeps trying.`);
}

function polling() {
  if (!S.polling) return null;
  return alarm(".accepted", "The service refuses live events to this page.", `Its reason: ${S.polling}. The page requests the state every second instead. Abort and Blackout work.`);
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
    sessionStorage.setItem("seen", id);
    S.failed = null;
    changed();
  }, { kind: "quiet" }));
}

function unsafe(latch) {
  const why = () => h("p", h("strong", "UNSAFE: treat every lamp as lit."), ` Since ${clock(latch.since)}: ${latch.detail.replace(/^unknown, unsafe: /, "")}`);
  const key = `latch|${latch.since}|${latch.detail}|${latch.ended_by}`;
  if (latch.ended_by === "blackout") return { key, make: () => ({ element: h(".alarm.latch", why(), h("p", "Nothing is lit until a blackout reads every lamp back dark. Stay out of the stage, cut the lamps' supply, remove the cause, then press ", h("b", "Blackout"), " (F9).")) }) };
  return { key, make: () => {
    const name = h("input", { name: "name", required: true, minlength: 2, placeholder: "your name", "aria-label": "your name" });
    const note = h("input", { name: "note", required: true, minlength: 4, placeholder: "what you saw", "aria-label": "what you saw" });
    return { element: h(".alarm.latch", why(), h("p", "This light bank cannot report whether its lamps are off. No lamp is lit until a person has inspected the stage and confirms it:"),
      h("form.line", { onsubmit: (event) => {
        event.preventDefault();
        attempt(() => ask("POST /devices/acknowledge", { name: name.value, note: note.value })).then(() => load.health());
      } }, name, note, h("button", "I looked: the lamps are off"))) };
  } };
}

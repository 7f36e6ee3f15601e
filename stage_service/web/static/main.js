// The frame around every view: state, alarms, abort and blackout.

import { abort, askName, attempt, left, notice } from "./acts.js";
import { alarmBox } from "./alarms.js";
import { service, tell } from "./ask.js";
import { blackout, pressed, resend, resume } from "./blackout.js";
import { button, clock, h, say, seconds } from "./dom.js";
import { contradicts, lampWords } from "./lamps.js";
import { loginForm } from "./login.js";
import { S, begin, busy, changed, load, mine, onChange, releaseLease, silence, takeLease } from "./state.js";
import { blackScreen } from "./black.js";
import * as now from "./now.js";
import * as plan from "./plan.js";
import * as calibrate from "./calibrate.js";
import * as cameras from "./cameras.js";
import * as frames from "./frames.js";
import * as stage from "./stage.js";
import * as jobs from "./jobs.js";

const VIEWS = { now: ["Now", now], plan: ["Plan", plan], cameras: ["Cameras", cameras], frames: ["Frames", frames], stage: ["Stage", stage], jobs: ["Jobs", jobs], calibrate: ["Calibrate", calibrate] };
const STATES = {
  idle: "starting", running: "shooting", pausing: "pausing …", paused: "paused", aborting: "aborting …",
  finishing: "finishing …",
};

const top = document.getElementById("top");
const view = document.getElementById("view");
let shown = null;

// Keys work in every view, fields and the login form included.
addEventListener("keydown", (event) => {
  const action = { F7: blackScreen, F8: abort, F9: blackout }[event.key];
  if (!action) return;
  event.preventDefault();
  action();
});

/** Where the stage is, in a word, and its tone. */
function stateWord() {
  if (S.out) return ["not logged in", "bad"];
  if (S.connected === null) return ["connecting", ""];
  if (document.hidden) return ["not followed", ""];
  const lamps = lampWords(S.health);
  if (busy() && !silence() && !S.health?.latch) return [STATES[S.capture.state], S.capture.state === "running" ? "on" : "warn"];
  return [lamps.bar, lamps.tone];
}

function bar() {
  const state = h("strong.state", { role: "status" }); // steps and seconds beside it would be read out four times a second
  const detail = h("span.detail");
  const steering = h("span.steering");
  const links = Object.entries(VIEWS).map(([name, [title]]) => h("a", { href: `#${name}` }, title));
  const views = h("nav", { "aria-label": "views" }, links);
  const label = h("span");
  const held = button("", () => attempt(async () => {
    if (mine()) await releaseLease();
    else await takeLease(await askName());
  }), { kind: "quiet" });
  const who = h(".who", steering, held);
  const stop = button("Abort", abort, { kind: "abort", "aria-keyshortcuts": "F8", title: "end at the next step, keep the frames (F8)" });
  const dark = button("", blackout, { kind: "blackout", "aria-keyshortcuts": "F9", title: "every lamp and projector off at once, read back where the device can (F9)" });
  const black = button("", blackScreen, { kind: "quiet", "aria-keyshortcuts": "F7", title: "turn this screen black (F7)" });
  say(black, "Black", h("kbd", "F7"));
  say(stop, "Abort", h("kbd", "F8"));
  say(dark, label, h("kbd", "F9"));
  top.replaceChildren(h(".where", state, detail), views, who, h(".stops", black, stop, dark));
  return () => {
    const c = S.capture;
    const silent = silence();
    const [word, tone] = stateWord();
    say(state, word);
    state.className = `state ${tone}`;
    const rig = S.rig?.name ?? "";
    say(detail, S.out ? "" : silent ? `since ${silent.clock}` : busy() ? `${c.step} of ${c.steps} steps · ${left(c)}` : rig);
    document.title = `${{ bad: "⚠ ", on: "● " }[tone] ?? ""}${word}${busy() && !silent && !S.out ? ` ${c.step}/${c.steps}` : ""} · ${rig || "hairstage"}`;
    for (const link of links) {
      const here = link.hash === `#${shown?.name}`;
      if (here) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    views.hidden = who.hidden = S.out;
    const other = S.lease.holder !== null && !mine();
    say(steering, S.lease.holder === null ? "no lease" : mine() ? "you steer" : `${S.lease.holder} steers`);
    steering.title = S.lease.holder === null ? "anybody may start a capture" : `until ${clock(S.lease.expires)}`;
    say(held, mine() ? "release" : "take");
    held.hidden = other || !(S.who?.scopes.includes("steer"));
    stop.disabled = S.out || !busy() || c.state === "aborting" || c.state === "finishing";
    const waiting = pressed?.going ? Math.floor((Date.now() - pressed.at) / 1000) : 0;
    say(label, !pressed?.going ? "Blackout" : waiting < 2 ? "going dark …" : `no response: ${waiting} s`);
    dark.classList.toggle("going", Boolean(pressed?.going));
  };
}

function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part; // typed by hand
  }
}

function show() {
  const name = location.hash.slice(1).split("/")[0];
  const [title, module] = VIEWS[name] ?? VIEWS.now;
  shown?.end?.();
  view.replaceChildren();
  scrollTo(0, 0);
  view.setAttribute("aria-label", title);
  shown = { name: VIEWS[name] ? name : "now", ...module.open(view, location.hash.slice(1).split("/").slice(1).map(decoded)) };
  changed();
}

/** Each change of the last press of Blackout. */
function onPressed() {
  changed();
  const answer = pressed?.answer;
  if (!answer && !pressed?.going) tell("yielded"); // refused, or dismissed
  if (!answer || S.out) return;
  const took = seconds((answer.at - pressed.at) / 1000);
  const doubted = contradicts(answer.detail) || contradicts(S.capture?.error);
  if (!answer.safe) notice("Blackout: unknown, unsafe. Treat every lamp as lit.", "bad");
  else notice(`${doubted ? "Reported dark" : "Dark, verified"}, after ${took}.`, "good");
  // What it has ended is read before pictures take the connections again: events may be refused to this page.
  load.now().catch(() => {}).then(() => tell("yielded"));
}

function onOver() {
  if (S.out) return;
  S.out = true;
  removeEventListener("hashchange", show);
  shown?.end?.();
  shown = null;
  loginForm(view);
  changed();
}

async function start() {
  try {
    await begin();
  } catch (error) {
    if (error.status === 401) return;
    say(view, h("p.bad", `The service does not respond (${error.message}). The page tries again.`));
    setTimeout(start, 2000);
    return;
  }
  resend();
  onChange(() => {
    if (S.rig && !shown && !S.out) {
      addEventListener("hashchange", show);
      show();
    } else if (S.rig) shown?.update?.();
    else if (S.problem && !S.out) say(view, h("p.bad", `The service refuses data that this page needs: ${S.problem}. The page tries again.`));
  });
  changed();
}

for (const part of [bar(), alarmBox(document.getElementById("alarms"))]) onChange(part);
service.addEventListener("over", onOver);
service.addEventListener("pressed", onPressed);
document.addEventListener("visibilitychange", () => changed());
changed();
resume();
start();

// The frame around every view: state, alarms, abort and blackout.

import { abort, attempt, notice, operatorName, timeLeft } from "./acts.js";
import { alarmBox } from "./alarms.js";
import { emit, service } from "./api.js";
import { blackout, pressed, resend, resume } from "./blackout.js";
import { button, clock, h, seconds, setContent } from "./dom.js";
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

// Keys work in every view, also in fields and in the login form.
addEventListener("keydown", (event) => {
  const action = { F7: blackScreen, F8: abort, F9: blackout }[event.key];
  if (!action) return;
  event.preventDefault();
  action();
});

/** The state of the stage in a word, and its tone. */
function stateWord() {
  if (S.loggedOut) return ["not logged in", "bad"];
  if (S.connected === null) return ["connecting", ""];
  if (document.hidden) return ["not followed", ""];
  const lamps = lampWords(S.health);
  if (busy() && !silence() && !S.health?.latch) return [STATES[S.capture.state], S.capture.state === "running" ? "on" : "warn"];
  return [lamps.bar, lamps.tone];
}

function bar() {
  const state = h("strong.state", { role: "status" }); // the changing steps and seconds stay outside of it: screen readers would repeat them
  const detail = h("span.detail");
  const steering = h("span.steering");
  const links = Object.entries(VIEWS).map(([name, [title]]) => h("a", { href: `#${name}` }, title));
  const views = h("nav", { "aria-label": "views" }, links);
  const label = h("span");
  const held = button("", () => attempt(async () => {
    if (mine()) await releaseLease();
    else await takeLease(await operatorName());
  }), { kind: "quiet" });
  const who = h(".who", steering, held);
  const stop = button("Abort", abort, { kind: "abort", "aria-keyshortcuts": "F8", title: "stop after this step, keep the frames (F8)" });
  const dark = button("", blackout, { kind: "blackout", "aria-keyshortcuts": "F9", title: "switch every lamp and projector off at once, with read-back if supported (F9)" });
  const black = button("", blackScreen, { kind: "quiet", "aria-keyshortcuts": "F7", title: "turn this screen black (F7)" });
  setContent(black, "Black", h("kbd", "F7"));
  setContent(stop, "Abort", h("kbd", "F8"));
  setContent(dark, label, h("kbd", "F9"));
  top.replaceChildren(h(".where", state, detail), views, who, h(".stops", black, stop, dark));
  return () => {
    const c = S.capture;
    const silent = silence();
    const [word, tone] = stateWord();
    setContent(state, word);
    state.className = `state ${tone}`;
    const rig = S.rig?.name ?? "";
    setContent(detail, S.loggedOut ? "" : silent ? `since ${silent.clock}` : busy() ? `${c.step} of ${c.steps} steps · ${timeLeft(c)}` : rig);
    document.title = `${{ bad: "⚠ ", on: "● " }[tone] ?? ""}${word}${busy() && !silent && !S.loggedOut ? ` ${c.step}/${c.steps}` : ""} · ${rig || "hairstage"}`;
    for (const link of links) {
      link.ariaCurrent = link.hash === `#${shown?.name}` ? "page" : null;
    }
    views.hidden = who.hidden = S.loggedOut;
    const other = S.lease.holder !== null && !mine();
    setContent(steering, S.lease.holder === null ? "no lease" : mine() ? "you steer" : `${S.lease.holder} steers`);
    steering.title = S.lease.holder === null ? "any operator may start a capture" : `until ${clock(S.lease.expires)}`;
    setContent(held, mine() ? "release" : "take");
    held.hidden = other || !(S.who?.scopes.includes("steer"));
    stop.disabled = S.loggedOut || !busy() || c.state === "aborting" || c.state === "finishing";
    const waiting = pressed?.going ? Math.floor((Date.now() - pressed.at) / 1000) : 0;
    setContent(label, !pressed?.going ? "Blackout" : waiting < 2 ? "going dark …" : `no response: ${waiting} s`);
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

/** The state of the last Blackout press has changed. */
function onPressed() {
  changed();
  const response = pressed?.response;
  if (!response && !pressed?.going) emit("yielded"); // refused, or dismissed
  if (!response || S.loggedOut) return;
  const took = seconds((response.at - pressed.at) / 1000);
  const doubted = contradicts(response.detail) || contradicts(S.capture?.error);
  if (!response.safe) notice("Blackout: unknown, unsafe. Treat every lamp as lit.", "bad");
  else notice(`${doubted ? "Reported dark" : "Dark, verified"}, after ${took}.`, "good");
  // Read the new state before images take the connections again: this page may have no event stream.
  load.now().catch(() => {}).then(() => emit("yielded"));
}

function onLoggedOut() {
  if (S.loggedOut) return;
  S.loggedOut = true;
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
    setContent(view, h("p.bad", `The service does not respond (${error.message}). The page tries again.`));
    setTimeout(start, 2000);
    return;
  }
  resend();
  onChange(() => {
    if (S.rig && !shown && !S.loggedOut) {
      addEventListener("hashchange", show);
      show();
    } else if (S.rig) shown?.update?.();
    else if (S.problem && !S.loggedOut) setContent(view, h("p.bad", `The service refused a request: ${S.problem}. The page tries again.`));
  });
  changed();
}

for (const part of [bar(), alarmBox(document.getElementById("alarms"))]) onChange(part);
service.addEventListener("logged out", onLoggedOut);
service.addEventListener("pressed", onPressed);
document.addEventListener("visibilitychange", () => changed());
changed();
resume();
start();

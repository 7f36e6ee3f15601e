// The frame around every view: where the stage is, what is wrong, and the way to darkness.

import { abort, askName, attempt, blackout, darkening, left } from "./acts.js";
import { ask, login } from "./ask.js";
import { button, clock, h, say } from "./dom.js";
import { lampWords } from "./lamps.js";
import { S, begin, busy, changed, load, mine, onChange, releaseLease, takeLease } from "./state.js";
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
const alarms = document.getElementById("alarms");
let shown = null;

// Keys work in every view, fields included.
addEventListener("keydown", (event) => {
  const action = { F7: blackScreen, F8: abort, F9: blackout }[event.key];
  if (!action) return;
  event.preventDefault();
  action();
});

function bar() {
  const state = h("strong.state", { role: "status" }); // steps and seconds beside it would be read out four times a second
  const detail = h("span.detail");
  const steering = h("span.steering");
  const links = Object.entries(VIEWS).map(([name, [title]]) => h("a", { href: `#${name}` }, title));
  const going = h("span");
  const held = button("", () => attempt(async () => {
    if (mine()) await releaseLease();
    else await takeLease(await askName());
  }), { kind: "quiet" });
  const stop = button("Abort", abort, { kind: "abort", "aria-keyshortcuts": "F8", title: "end at the next step, keep the frames (F8)" });
  const dark = button("", blackout, { kind: "blackout", "aria-keyshortcuts": "F9", title: "every lamp and projector off at once, read back where that can be (F9)" });
  const black = button("", blackScreen, { kind: "quiet", "aria-keyshortcuts": "F7", title: "nothing on this screen shines (F7)" });
  say(black, "Black", h("kbd", "F7"));
  say(stop, "Abort", h("kbd", "F8"));
  say(dark, going, h("kbd", "F9"));
  top.replaceChildren(
    h(".where", state, detail),
    h("nav", { "aria-label": "views" }, links),
    h(".who", steering, held),
    h(".stops", black, stop, dark),
  );
  return () => {
    const c = S.capture;
    const lamps = lampWords(S.health);
    const [word, tone] = S.connected === null ? ["connecting", ""] : S.connected === false ? ["no connection", "bad"] : busy() && !S.health?.latch ? [STATES[c.state], c.state === "running" ? "on" : "warn"] : [lamps.bar, lamps.tone];
    say(state, word);
    state.className = `state ${tone}`;
    const rig = S.rig?.name ?? "";
    say(detail, busy() ? `${c.step} of ${c.steps} steps · ${left(c)}` : rig);
    document.title = `${{ bad: "⚠ ", on: "● " }[state.className.split(" ")[1]] ?? ""}${word}${busy() ? ` ${c.step}/${c.steps}` : ""} · ${rig || "hairstage"}`;
    for (const link of links) {
      const here = link.hash === `#${shown?.name}`;
      if (here) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    const other = S.lease.holder !== null && !mine();
    say(steering, S.lease.holder === null ? "nobody steers" : mine() ? "you steer" : `${S.lease.holder} steers`);
    steering.title = S.lease.holder === null ? "anybody may start a capture" : `until ${clock(S.lease.expires)}`;
    say(held, mine() ? "release" : "take");
    held.hidden = other || !(S.who?.scopes.includes("steer"));
    stop.disabled = !busy() || c.state === "aborting" || c.state === "finishing";
    say(going, darkening ? (darkening.tries > 1 ? `Blackout: try ${darkening.tries}` : "going dark …") : "Blackout");
    dark.classList.toggle("going", darkening !== null);
  };
}

function alarmBox() {
  return () => {
    const told = [];
    const latch = S.health?.latch;
    const { state, alarm } = lampWords(S.health);
    if (S.connected === false) told.push(h(".alarm", h("strong", "No connection to the service. "), `What is shown here is of ${clock(S.lostAt)}; the stage may be lit. It is tried again by itself; `, h("b", "Blackout"), " is, too."));
    if (latch) told.push(unsafe(latch));
    else if (alarm) told.push(h(`.alarm.${state}`, h("strong", alarm[0]), alarm[1]));
    if (S.failed) told.push(h(".alarm", h("strong", `Capture ${S.failed.id} failed. `), latch ? (S.failed.error ?? "").split("; blackout: ")[0] : S.failed.error ?? "", " ", button("seen", () => {
      sessionStorage.setItem("seen", S.failed.id);
      S.failed = null;
      changed();
    }, { kind: "quiet" })));
    const text = told.map((x) => x.textContent).join();
    if (alarms.dataset.text === text) return;
    alarms.dataset.text = text;
    alarms.replaceChildren(...told);
  };
}

function unsafe(latch) {
  const why = h("p", h("strong", "UNSAFE: treat every lamp as lit. "), `Since ${clock(latch.since)}: ${latch.detail}`);
  if (latch.ended_by === "blackout") return h(".alarm.latch", why, h("p", "Nothing is lit until a blackout reads every lamp back dark: mend the cause, then press ", h("b", "Blackout"), " (F9)."));
  const name = h("input", { name: "name", required: true, minlength: 2, placeholder: "your name", "aria-label": "your name" });
  const note = h("input", { name: "note", required: true, minlength: 4, placeholder: "what you saw", "aria-label": "what you saw" });
  return h(".alarm.latch", why, h("p", "This light bank cannot say whether its lamps are off. Nothing is lit until somebody has looked and says so:"),
    h("form.line", { onsubmit: (event) => {
      event.preventDefault();
      attempt(() => ask("POST /devices/acknowledge", { name: name.value, note: note.value })).then(() => load.health());
    } }, name, note, h("button", "I looked: the lamps are off")));
}

function show() {
  const name = location.hash.slice(1).split("/")[0];
  const [title, module] = VIEWS[name] ?? VIEWS.now;
  shown?.end?.();
  view.replaceChildren();
  scrollTo(0, 0);
  view.setAttribute("aria-label", title);
  shown = { name: VIEWS[name] ? name : "now", ...module.open(view, location.hash.slice(1).split("/").slice(1)) };
  changed();
}

function loginForm() {
  document.title = "log in · hairstage";
  const token = h("input", { type: "password", name: "token", required: true, autocomplete: "current-password", maxlength: 200 });
  const wrong = h("p.bad", { role: "alert" });
  top.replaceChildren();
  alarms.replaceChildren();
  view.replaceChildren(h("form.login", { onsubmit: async (event) => {
    event.preventDefault();
    try {
      await ask("POST /login", { token: token.value.trim() });
      location.reload();
    } catch (error) {
      say(wrong, error.message);
    }
  } }, h("h1", "hairstage"), h("label", "Your token", token), h("p.quiet", h("code", "hairstage token show"), " prints it, on the service's machine."), wrong, h("button.go", "Log in")));
  token.focus();
}

async function start() {
  login.addEventListener("over", () => { if (!document.querySelector("form.login")) loginForm(); });
  try {
    await begin();
  } catch (error) {
    if (error.status === 401) return;
    say(view, h("p.bad", `The service does not answer (${error.message}). It is tried again.`));
    setTimeout(start, 2000);
    return;
  }
  const parts = [bar(), alarmBox()];
  onChange(() => {
    for (const part of parts) part();
    if (S.rig) shown?.update?.();
  });
  let opened = false;
  onChange(() => {
    if (opened || !S.rig) return;
    opened = true;
    addEventListener("hashchange", show);
    show();
  });
  changed();
}

start();

// The present state: lit light, progress of the capture, lamps, queue.

import { confirmed, promptName, steering, timeLeft } from "./acts.js";
import { captureAt, get, request } from "./api.js";
import { bytes, clock, h, keyed, local, number, seconds, setContent } from "./dom.js";
import { dome } from "./dome.js";
import { lampWords, suspects } from "./lamps.js";
import { S, busy, load, silence, unlit } from "./state.js";

const STATE_TEXT = {
  idle: "The capture is about to begin.",
  running: "",
  pausing: "The capture pauses after this step and switches the lamps off.",
  paused: "Paused. Lamps and projectors were switched off.",
  aborting: "The capture stops after this step. Blackout (F9) acts at once.",
  finishing: "Lamps are switched off; the last frames are written.",
};

const HOW = { completed: "is complete", aborted: "was aborted", failed: "failed", interrupted: "was interrupted", damaged: "is damaged" };
const HEADLINES = { idle: "Starting", running: "Shooting", pausing: "Pausing …", paused: "Paused", aborting: "Aborting …", finishing: "Finishing …" };
const SLOW_MS = 1000; // a longer step shows how many cameras have responded

export function open(view) {
  const picture = dome(S.rig, { label: "the dome from above, with the light that is lit" });
  const lit = h("p.lit", { "aria-live": "off" });
  const word = h("h1.big");
  const status = h("p.status");
  const meter = h("progress", { "aria-label": "capture", max: 1 });
  const facts = h("dl.facts");
  const cameras = h("table.cameras", h("thead", h("tr", h("th", "camera"), h("th.n", "frames"), h("td"))), h("tbody"));
  const byCamera = h("section", h("h2", "Frames by camera"), cameras);
  const missing = h("ul.missing");
  const pause = steering("Pause", () => steer("pause"), { ready: () => S.capture?.state === "running" && !S.capture.progress?.by_box });
  const resume = steering("Resume", () => steer("resume"), { kind: "go", lights: true, ready: () => ["paused", "pausing"].includes(S.capture?.state) });
  const finish = steering("Shoot what is missing", () => steer("resume"), { lights: true, ready: () => S.capture?.state === "done" && !["completed", "damaged"].includes(S.capture?.outcome) });
  const fresh = h("a.button", { href: "#plan" }, "New capture");
  const releaseQueue = steering("Release the queue", () => release(S.queue.hold), { lights: true, ready: () => S.queue.hold !== null });
  const line = h("ol.queue");
  const queueStatus = h("p.quiet");
  view.append(h(".now",
    h("section.stagepicture", { "aria-label": "dome" }, picture.element, lit,
      h("p.key", h("span.k.todo", "to come"), h("span.k.done", "shot"), h("span.k.gone", "frames missing"), h("span.k.on", "lit"), h("span.k.maybe", "may be lit"), h("span.k.eye", "camera"), h("span.k.beam", "projector"))),
    h("section.course", { "aria-label": "capture" }, word, status, meter,
      h(".line", pause.element, resume.element, finish.element, fresh),
      facts,
      h(".two", byCamera, h("section", h("h2", "Shot again or missing"), missing)),
      h("section", h("h2", "Queue"), queueStatus, line, releaseQueue.element)),
  ));

  let steps = null; // of the capture that is shown
  let stepsOf = null;
  let stepsAtEnd = false; // whether they were requested after its end
  const waits = { step: null, slow: false, timer: 0 };
  const lacking = () => new Set((steps ?? []).filter((s) => (stepsAtEnd && !busy() && s.lacks.length && s.index < S.capture.step) || S.missing.some((x) => !x.shot_again && x.step === s.index)).map((s) => s.light).filter(Boolean));

  /** End the hold that this page shows, after the person has confirmed its reasons. */
  async function release(hold) {
    if (!hold) return;
    const reasons = hold.reasons.map((r) => h("li", `${clock(r.at)}: ${local(r.why)}`));
    await confirmed("release the queue", [h("p", "The queue is held:"), h("ul.problems", reasons), h("p", "Begin the queued captures, one after the other?")], "Begin");
    try {
      await request("POST /queue:go-on", { hold: hold.id });
    } finally {
      await load.queue();
    }
  }

  async function steer(action) {
    await request(`POST ${captureAt(S.capture.id)}/${action}`, action === "resume" ? {} : undefined);
    await load.capture(S.capture.id);
  }

  function update() {
    const c = S.capture;
    for (const part of [pause, resume, finish, releaseQueue]) part.update();
    pause.element.hidden = !busy() || ["paused", "pausing"].includes(c?.state);
    resume.element.hidden = !["paused", "pausing"].includes(c?.state);
    finish.element.hidden = busy() || !c || ["completed", "damaged"].includes(c.outcome) || unlit() !== null;
    fresh.hidden = unlit() !== null || silence() !== null;
    releaseQueue.element.hidden = S.queue.hold === null;
    queueOf();
    if (!c) {
      headlineOfLamps();
      setContent(status, "No capture has been made here yet.");
      meter.hidden = true;
      showFacts([lamps(), disk()]);
      picture.show({ doubt: suspects() });
      return;
    }
    const of = `${c.id} ${busy()}`; // requested again at its end: only then the missing frames of each step are known
    if (stepsOf !== of && S.connected) {
      stepsOf = of;
      if (steps?.of !== c.id) steps = null;
      get(`${captureAt(c.id)}/steps`).then((list) => { if (stepsOf === of) { steps = list; steps.of = c.id; stepsAtEnd = !busy(); update(); } }).catch(() => { stepsOf = null; });
    }
    headline(c);
    meter.hidden = false;
    const p = c.progress;
    meter.value = p?.share ?? c.step / (c.steps || 1);
    const frames = p ? Object.values(p.frames).reduce((a, b) => a + b, 0) : c.frames_written;
    showFacts([
      ["Capture", h("a", { href: `#frames/${encodeURIComponent(c.id)}` }, c.id)],
      ["Steps", `${number(c.step)} of ${number(c.steps)}`],
      ["Frames", `${number(frames)} of ${number(c.frames_planned)}`],
      busy() ? ["Time left", silence() ? "not known" : p?.seconds_left == null ? `not known yet (predicted ${seconds(c.seconds_predicted)} in all)` : timeLeft(c)] : ["Duration", `${seconds(c.seconds)} (predicted ${seconds(c.seconds_predicted)})`],
      ["Shot again", number(p?.again ?? S.missing.filter((x) => x.shot_again).length)],
      ["Missing", h(c.frames_missing ? "b.bad" : "span", number(c.frames_missing))],
      ["Then", c.job ? h("a", { href: `#jobs/${c.job}` }, c.request.pipeline?.name ?? c.job) : c.request.pipeline?.name ?? "nothing follows"],
      p?.by_box ? ["Clocked by", "the trigger box: no pause until its run is over"] : null,
      lamps(), disk(),
    ]);
    showLights(c, p);
    framesBy(c, p);
    // A page opened after the capture received no events: list the missing frames of each step.
    const lost = S.missing.length || busy() ? S.missing : (steps ?? []).filter((s) => s.lacks.length && s.index < c.step).map((s) => ({ step: s.index, cameras: s.lacks, attempt: 0, shot_again: false }));
    keyed(missing, lost.slice(0, 12), (x) => `${x.step}/${x.attempt}/${x.cameras}`, (x) => ({
      element: h("li", `step ${x.step}${steps?.[x.step]?.light ? ` (${steps[x.step].light})` : ""}: ${x.cameras.join(", ")} — `, x.shot_again ? "shot again" : h("b.bad", "given up")),
    }));
    if (!lost.length && !missing.childElementCount) missing.append(h("li.quiet", "none"));
    else if (lost.length) missing.querySelector(".quiet")?.remove();
  }

  function headline(c) {
    const silent = silence();
    if (busy() && !silent) {
      word.className = "big";
      setContent(word, HEADLINES[c.state]);
      setContent(status, STATE_TEXT[c.state], c.error ? h("b.bad", ` ${c.error}`) : "");
      return;
    }
    headlineOfLamps();
    const last = busy() ? `${HEADLINES[c.state].toLowerCase()}, step ${number(c.step)} of ${number(c.steps)}.` : `Capture ${c.id} ${HOW[c.outcome]}${c.started ? `, started ${clock(c.started)}` : ""}.${c.error && !S.failed ? ` ${c.error}` : ""}`;
    setContent(status, silent ? `Last known at ${silent.clock}: ${last}` : last);
  }

  function headlineOfLamps() {
    const { headline: text, tone } = lampWords(S.health);
    word.className = `big ${tone === "calm" ? "" : tone}`;
    setContent(word, text);
  }

  function lamps() {
    const { state, fact, detail } = lampWords(S.health);
    const kind = silence() ? "b.bad" : { latched: "b.bad", unknown: "b.bad", accepted: "b.warn", doubted: "b.warn" }[state] ?? "span";
    const besides = state === "dark" && !silence() ? detail.split(/(?=; )/).slice(1).join("").replace(/\.$/, "") : ""; // other devices that switch lamps off
    return ["Lamps", h(kind, { title: detail }, state === "use" && S.capture?.state === "paused" ? "switched off for the pause" : fact + besides)];
  }
  function disk() {
    const free = S.health?.disk_free_bytes;
    return ["Disk", free === null ? h("b.bad", "does not respond") : `${bytes(free)} free`];
  }
  function showFacts(rows) {
    keyed(facts, rows.filter(Boolean), ([name]) => name, ([name]) => {
      const dd = h("dd");
      let last = null;
      return { element: h("div", h("dt", name), dd), update([, value]) {
        const now = value instanceof Node ? value.outerHTML : String(value);
        if (now !== last) setContent(dd, value);
        last = now;
      } };
    });
  }

  function showLights(c, p) {
    const running = ["running", "pausing", "aborting"].includes(c.state) && !silence();
    const now = running && p ? p : {};
    const last = silence() && busy() && p ? p : {}; // lit at the last contact with the service
    const shot = new Set((steps ?? []).slice(0, c.step).map((s) => s.light).filter(Boolean));
    picture.show({
      lit: now.kind === "all_on" || now.kind === "pattern" ? "all" : now.light ?? null,
      shot, missing: lacking(),
      projector: now.kind === "tracking" ? "all" : now.projector ?? null,
      doubt: last.kind === "all_on" || last.kind === "pattern" ? new Set(S.rig.lights.map((x) => x.name)) : last.light ? new Set([last.light]) : suspects(),
    });
    const what = !running || !now.kind ? (busy() ? STATE_TEXT[c.state] || "about to begin" : "nothing is lit") : { olat: now.light, pattern: `lights of pattern ${now.pattern}`, all_on: "all lights", dark: "no light: a dark frame", tracking: "all projectors", scanline: `${now.projector}, row ${now.row}` }[now.kind];
    waitsAt(running && p && !p.by_box ? `${c.id} ${p.step}` : null);
    const responded = waits.slow && p.here ? ` · ${number(p.here)} of ${number(S.rig.cameras.length)} cameras have responded` : "";
    const w = running ? p?.waiting : null;
    const waiting = w ? ` · ${w.doing || `waiting for ${w.cameras[0]}${w.cameras.length > 1 ? ` and ${number(w.cameras.length - 1)} more` : ""}`}, ${seconds(w.seconds)}` : "";
    setContent(lit, busy() && !silence() ? what + responded + waiting : lampWords(S.health).lit);
  }

  function waitsAt(step) {
    if (step === waits.step) return;
    clearTimeout(waits.timer);
    Object.assign(waits, { step, slow: false });
    if (step !== null) waits.timer = setTimeout(() => { waits.slow = true; update(); }, SLOW_MS);
  }

  function framesBy(c, p) {
    byCamera.hidden = !p;
    if (!p) return;
    const names = S.rig.cameras.map((x) => x.name);
    const each = c.steps;
    keyed(cameras.tBodies[0], names.map((name) => [name, p.frames[name] ?? 0]), ([name]) => name, () => {
      const count = h("td.n");
      const share = h("progress", { max: 1 });
      const cell = h("th", { scope: "row" });
      return {
        element: h("tr", cell, count, h("td", share)),
        update([name, n]) {
          setContent(cell, name);
          setContent(count, number(n));
          share.setAttribute("aria-label", `${name}: ${n} of ${each} frames`);
          share.value = n / (each || 1);
        },
      };
    });
  }

  function queueOf() {
    const q = S.queue;
    setContent(queueStatus, q.held ? `Held: ${q.held}. No queued capture starts until the queue is released.` : q.waiting.length ? (q.waits_for ? `The first one waits: ${q.waits_for}.` : "The first one is about to begin.") : "The queue is empty.");
    keyed(line, q.waiting, (x) => x.id, (x) => {
      const go = steering("start now", async () => request(`POST /queue/${x.id}/start`, x.needs_arming ? { armed_by: await promptName("Person at the stage responsible for the flashes", "Start") } : undefined), { kind: "quiet", lights: true });
      const up = steering("first", () => request(`PATCH /queue/${x.id}`, { place: 0 }), { kind: "quiet" });
      const at = () => S.queue.waiting.findIndex((y) => y.id === x.id);
      const place = (text, by, more) => steering(text, () => request(`PATCH /queue/${x.id}`, { place: at() + by }), { kind: "quiet", ready: () => S.queue.waiting[at() + by] !== undefined, ...more });
      const sooner = place("↑", -1, { "aria-label": "sooner" });
      const later = place("↓", 1, { "aria-label": "later" });
      const out = steering("remove", () => request(`DELETE /queue/${x.id}`), { kind: "quiet" });
      const parts = [go, up, sooner, later, out];
      return { element: h("li", h("span", planWords(x.request.plan), h("small", ` by ${x.by}, ${clock(x.added)}${x.needs_arming ? " · flashes: start it at the stage" : ""}`)), parts.map((b) => b.element)), update: () => parts.forEach((b) => b.update()) };
    });
  }

  return { update, end: () => clearTimeout(waits.timer) };
}

function planWords(plan = {}) {
  const lights = plan.lights === undefined || plan.lights === "all" ? "all lights" : `${plan.lights.length} lights`;
  const sweep = plan.projectors === undefined || plan.projectors === "all" ? "sweep" : plan.projectors.length ? `sweep of ${plan.projectors.join(", ")}` : "no sweep";
  return `${lights}, ${sweep}`;
}


// A capture plan and its cost; start it or queue it.

import { attempt, notice, steering, underLease } from "./acts.js";
import { get, request } from "./api.js";
import { bytes, definitions, h, number, seconds, setContent, words } from "./dom.js";
import { dome } from "./dome.js";
import { formOf } from "./form.js";
import { S, busy, load } from "./state.js";

const spread = (lights, n) => lights.filter((_, i) => Math.floor((i * n) / lights.length) !== Math.floor(((i - 1) * n) / lights.length)).slice(0, n).map((x) => x.name);
const PRESETS = {
  "everything": () => ({}),
  "lights only": () => ({ projectors: [] }),
  "patterns of lights": () => ({ patterns: "s_matrix", projectors: [] }),
  "sweep only": () => ({ lights: [] }),
  "quick look: 12 lights": () => ({ lights: spread(S.rig.lights, 12), projectors: [] }),
  "slow, for eyes": () => ({ rate_hz: 2.5 }),
};
const TYPING_MS = 120;
let kept = null; // the input, kept when another view is opened

export function open(view) {
  const side = h("aside.cost", { "aria-live": "polite" }, h("p.quiet", "…"));
  const main = h("div");
  view.append(h(".split", main, side));
  let form = null;
  let cost = null;
  let latest = 0;
  let timer = 0;
  const picker = dome(S.rig, { label: "lights to capture: click to select", onpick: pick });
  const then = thenFields();
  const start = steering("Start now", begin, { kind: "go", lights: true, ready: () => cost !== null && !busy() });
  const queue = steering("Put into the queue", enqueue, { ready: () => cost !== null });

  get("/openapi.json").then((api) => {
    const schemas = api.components.schemas;
    const d = S.rig.defaults;
    const hints = { tracking_every: `${d.tracking_every} (rig file)`, retries: `${d.retries} (rig file)`, rate_hz: "as fast as possible", "rows.last": "the last", lights: "all, or names", projectors: "all, none, or names", consent: "who agreed, and to what" };
    for (const group of ["exposure", "level"]) for (const [kind, value] of Object.entries(d[group])) hints[`${group}.${kind}`] = `${value} (rig file)`;
    form = formOf(schemas.CapturePlan, schemas, { hints, onchange: typed });
    if (kept) form.fill(kept);
    main.append(
      h("h1", "Plan a capture"),
      h(".presets", { role: "group", "aria-label": "presets" }, Object.entries(PRESETS).map(([name, make]) => h("button", { type: "button", onclick: () => { form.fill(make()); typed(); } }, name))),
      form.element,
      h("fieldset", h("legend", "lights"), h("p.quiet", "Click lights to select them. If none is selected, the capture uses all."), h(".picker", picker.element)),
      then.element,
      h("details", h("summary", "fields of a plan"), h("p.quiet", schemas.CapturePlan.description)),
    );
    typed();
  }).catch((error) => setContent(main, h("p.bad", error.message)));

  function pick(name) {
    const lights = form?.get("lights");
    const chosen = new Set(Array.isArray(lights) ? lights : []);
    if (!chosen.delete(name)) chosen.add(name);
    form.set("lights", chosen.size ? S.rig.lights.map((x) => x.name).filter((x) => chosen.has(x)) : undefined);
  }

  function typed() {
    kept = form.value();
    picker.show({ chosen: new Set(Array.isArray(kept.lights) ? kept.lights : []) });
    clearTimeout(timer);
    timer = setTimeout(validate, TYPING_MS);
  }

  async function validate() {
    const run = ++latest;
    try {
      const found = await request("POST /plans:validate", kept);
      if (run !== latest) return;
      cost = found;
      setContent(side, ...costOf(found));
    } catch (error) {
      if (run !== latest) return;
      cost = null;
      const problems = error.data?.problems ?? error.data?.errors?.map((e) => `${e.loc}: ${e.msg}`) ?? [error.message];
      setContent(side, h("h2", "This plan cannot be captured"), h("ul.problems", problems.map((text) => h("li", text))));
    }
    side.append(arming, h(".line", start.element, queue.element), h("p.quiet", "Starting takes the lease: until you release it, others may abort and send Blackout, but not steer."));
    update();
  }

  const armed = h("input", { name: "armed_by", maxlength: 100, autocomplete: "name" });
  const arming = h("label", h("span.warn", "person at the stage responsible for the flashes"), armed);

  function costOf(c) {
    const causes = Object.entries(c.seconds_by_cause).filter(([, s]) => s > 0).sort((a, b) => b[1] - a[1]);
    const most = causes.length ? causes[0][1] : 1;
    const f = c.flash;
    const free = S.health?.disk_free_bytes;
    return [
      h("h2", "Cost"),
      h("dl.facts", definitions({
        "Time": seconds(c.seconds), "Frames": number(c.frames),
        "Steps": number(c.steps), "Disk": h(free !== null && c.bytes > free ? "b.bad" : "span", `${bytes(c.bytes)}${free ? ` of ${bytes(free)}` : ""}`),
        "Dose at the head, J/m²": c.dose.map((x) => number(x)).join(" · "), "Lamp seconds": number(c.lamp_seconds),
        "Flashes": h(f.needs_consent ? "b.warn" : "span", `${f.hz ? `${number(f.hz)} Hz, ` : ""}${f.band}`), "Limited by": c.limited_by,
      })),
      h(".bars", causes.map(([name, s]) => [h("span", words(name)), h("progress", { max: most, value: s, "aria-label": name }), h("span.n", seconds(s))])),
      f.needs_consent ? h("p.note", "Flashes of 3 to 30 Hz before a living subject: record the consent in the plan and name the person at the stage responsible for it, or choose the preset “slow, for eyes”.") : null,
      h("p.quiet", c.stepping_why),
      c.left_out.map((x) => h("p.note", `Skipped: ${x.what}: ${x.why} (saves ${x.saved})`)),
    ];
  }

  const wanted = () => ({ plan: kept, ...then.value() });

  async function begin() {
    await underLease();
    const made = await request("POST /captures", { ...wanted(), ...(cost.flash.needs_consent && armed.value ? { armed_by: armed.value } : {}) });
    await load.capture(made.id);
    location.hash = "#now";
  }

  async function enqueue() {
    await request("POST /queue", wanted());
    notice("The capture is in the queue.");
  }

  function update() {
    start.update();
    queue.update();
    arming.hidden = !cost?.flash.needs_consent;
  }
  return { update, end: () => clearTimeout(timer) };
}

/** The subject, and the pipeline to run after the capture. */
function thenFields() {
  const uploads = h("select", { name: "upload" }, h("option", { value: "" }, "–"));
  const head = h("input", { name: "head", placeholder: "/path/on/the/service/head.obj", spellcheck: false });
  const masks = h("input", { name: "masks", placeholder: "folder of CAMERA.png", spellcheck: false });
  const pipeline = h("select", { name: "pipeline" }, ["", "light_planes", "reconstruct", "full"].map((x) => h("option", { value: x }, x || "nothing")));
  const held = h("input", { name: "held_out_cameras", placeholder: "none", list: "cameras" });
  const heldLights = h("input", { name: "held_out_lights", placeholder: "none" });
  attempt(async () => {
    for (const folder of await get("/uploads")) uploads.append(h("option", { value: folder.name }, folder.name));
    const api = await get("/openapi.json");
    const known = api.components.schemas.PipelineRequest?.properties?.name?.enum;
    if (known) pipeline.replaceChildren(...["", ...known].map((x) => h("option", { value: x }, x || "nothing")));
  });
  const names = (field) => field.value.split(/[\s,]+/).filter(Boolean);
  return {
    element: h("fieldset", h("legend", "subject and job"), h(".fields",
      h("label", h("span", "uploaded subject"), uploads), h("label", h("span", "or head"), head), h("label", h("span", "and masks"), masks),
      h("label", h("span", "then run"), pipeline), h("label", h("span", "held-out cameras"), held), h("label", h("span", "held-out lights"), heldLights))),
    value() {
      const out = {};
      if (uploads.value) out.upload = uploads.value;
      if (head.value) out.head = head.value;
      if (masks.value) out.masks = masks.value;
      if (pipeline.value) out.pipeline = { name: pipeline.value, options: { held_out_cameras: names(held), held_out_lights: names(heldLights) } };
      return out;
    },
  };
}

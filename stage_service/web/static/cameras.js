// Snapshots: one exposure, or one every few seconds.

import { attempt, steering } from "./acts.js";
import { get, request } from "./api.js";
import { h, numberIn, seconds, setContent } from "./dom.js";
import { pictures } from "./pictures.js";
import { S, busy, onEvents } from "./state.js";

let last = null; // the displayed step; `of`: when it started

export function open(view) {
  const controller = new AbortController();
  const d = S.rig.defaults;
  const light = h("select", { name: "light", onchange: hints }, h("option", { value: "" }, "all lights"), S.rig.lights.map((x) => h("option", { value: x.name }, x.name)));
  const exposure = h("input", { type: "number", name: "exposure", min: 1e-6, max: 10, step: "any", "aria-label": "exposure, s" });
  const level = h("input", { type: "number", name: "level", min: 0.0001, max: 1, step: "any", "aria-label": "level" });
  const again = h("select", { name: "again", onchange: plan }, [[0, "once"], [2, "every 2 s"], [5, "every 5 s"], [15, "every 15 s"]].map(([v, t]) => h("option", { value: v }, t)));
  const marked = h("input", { type: "checkbox", checked: true, onchange: show });
  const figures = h("input", { type: "checkbox", checked: true, onchange: show });
  const take = steering("Take a snapshot", shoot, { kind: "go", lights: true, ready: () => !busy() });
  const what = h("p.quiet", "A snapshot lights the stage for one exposure. The service keeps it until the next one and does not list it as a capture.");
  const grid = h(".grid");
  const cells = pictures(grid, controller.signal);
  view.append(h("h1", "Cameras"),
    h("form.line", { onsubmit: (event) => { event.preventDefault(); attempt(shoot); } },
      h("label", h("span.quiet", "light "), light), h("label", h("span.quiet", "exposure, s "), exposure), h("label", h("span.quiet", "level "), level),
      h("label", h("span.quiet", "again "), again), take.element),
    h(".line", h("label.check", marked, h("span", "mark saturated pixels")), h("label.check", figures, h("span", "histogram, focus"))),
    what, grid);
  let timer = 0;

  function hints() {
    const kind = light.value ? "olat" : "all_on";
    exposure.placeholder = `${d.exposure[kind]}`;
    level.placeholder = `${d.level[kind]}`;
  }

  async function shoot() {
    await request("POST /snapshot", { light: light.value || null, exposure: numberIn(exposure), level: numberIn(level) });
  }

  async function look() {
    const [c, steps] = await Promise.all([get("/captures/snapshot", { signal: controller.signal }), get("/captures/snapshot/steps", { signal: controller.signal })]);
    if (c.state !== "done") return;
    last = { ...steps[0], of: c.started };
    setContent(what, `${last.light ?? "all lights"}, ${seconds(last.exposure)}, level ${last.level}${c.outcome === "completed" ? "" : `: ${c.error ?? c.outcome}`}`);
    show();
  }

  function show() {
    if (!last) return;
    const query = [`of=${encodeURIComponent(last.of)}`, ...(marked.checked ? ["mark=true"] : [])];
    cells.show((camera) => `/captures/snapshot/frames/0/${encodeURIComponent(camera)}`, { words: last.light ?? "all lights", lacks: last.lacks, figures: figures.checked, query });
  }

  function plan() {
    clearTimeout(timer);
    if (Number(again.value)) timer = setTimeout(repeat, 1000 * again.value);
  }

  /** Skipped while the page is hidden, a capture runs or another operator steers. */
  async function repeat() {
    if (!document.hidden && !take.element.disabled && !cells.busy) await attempt(shoot);
    plan();
  }

  const stop = onEvents(["capture.over"], ({ detail }) => { if (detail.id === "snapshot") look().catch(() => {}); });
  hints();
  if (last) look().catch(() => {}); // the service may have removed it
  return { update: take.update, end() { clearTimeout(timer); controller.abort(); stop(); } };
}

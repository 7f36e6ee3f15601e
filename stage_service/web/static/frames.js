// Captures and their frames, by camera and by light.

import { attempt } from "./acts.js";
import { captureAt, get } from "./api.js";
import { button, clock, definitions, h, keyed, number, seconds, setContent } from "./dom.js";
import { pictures } from "./pictures.js";
import { S, onEvents } from "./state.js";

const PAGE = 50;
const FILM_MS = 120;
const LISTED = ["capture.state", "capture.over", "capture.removed", "capture.restored", "captures.read", "fresh"];

export function open(view, [requestedId]) {
  const list = h(".list", { role: "group", "aria-label": "captures" });
  const older = button("older", () => turn(PAGE), { kind: "quiet" });
  const newer = button("newer", () => turn(-PAGE), { kind: "quiet" });
  const which = h("select", { "aria-label": "captures by outcome", onchange: () => { offset = 0; loadList(); } },
    ["", "completed", "aborted", "failed", "interrupted", "damaged"].map((x) => h("option", { value: x }, x || "all captures")));
  const detail = h("section");
  view.append(h(".side", h("section", { "aria-label": "captures" }, h("h1", "Captures"), which, list, h(".line", newer, older)), detail));

  let offset = 0;
  let shown = null; // {id, stop, update}

  function turn(by) {
    offset = Math.max(0, offset + by);
    loadList();
  }

  async function loadList() {
    const found = await attempt(() => get(`/captures?limit=${PAGE}&offset=${offset}${which.value ? `&outcome=${which.value}` : ""}`));
    if (!found) return;
    keyed(list, found.reverse(), (c) => c.id, (c) => {
      const name = h("span");
      const element = h("button", { type: "button", onclick: () => choose(c.id) }, name);
      return { element, update(x) { setContent(name, x.id, h("br"), h(`small${x.outcome === "failed" || x.outcome === "damaged" ? ".bad" : ""}`, `${x.outcome ?? x.state}, ${number(x.frames_written)} of ${number(x.frames_planned)} frames`)); element.dataset.id = x.id; } };
    });
    if (!found.length) setContent(list, h("p.quiet", offset ? "No older captures." : "No captures."));
    newer.disabled = offset === 0;
    older.disabled = found.length < PAGE;
    mark();
    if (!shown && (requestedId || found.length)) choose(requestedId ?? found[0].id);
  }

  function mark() {
    for (const row of list.querySelectorAll("button")) {
      row.ariaCurrent = row.dataset.id === shown?.id ? "true" : null;
    }
  }

  function choose(id) {
    shown?.stop();
    shown = { id, ...captureOf(detail, id) };
    history.replaceState(null, "", `#frames/${encodeURIComponent(id)}`);
    mark();
  }

  function onChange({ type, detail: capture }) {
    if (type === "capture.removed" && capture.id === shown?.id) {
      shown.stop();
      shown = requestedId = null;
      detail.replaceChildren();
    }
    loadList();
  }
  const stop = onEvents(LISTED, onChange);
  loadList();
  return { end() { stop(); shown?.stop(); }, update() { shown?.update(); } };
}

function captureOf(view, id) {
  const controller = new AbortController();
  let steps = [];
  let status = null;
  let film = 0;
  let white = null;
  const facts = h("dl.facts");
  const title = h("h2.title", id);
  const acts = h(".line");
  const slider = h("input", { type: "range", min: 0, max: 0, value: 0, "aria-label": "step", oninput: () => { stopFilm(); show(); } });
  const where = h("output", "");
  const kinds = h("select", { "aria-label": "steps by kind", onchange: pick }, [["olat", "each light"], ["pattern", "each pattern"], ["scanline", "the sweep"], ["all", "all steps"]].map(([v, t]) => h("option", { value: v }, t)));
  const same = h("input", { type: "checkbox", checked: true, onchange: () => { white = null; show(); } });
  const marked = h("input", { type: "checkbox", onchange: show });
  const figures = h("input", { type: "checkbox", onchange: show });
  const play = button("film", toggleFilm, { kind: "quiet" });
  const grid = h(".grid");
  const shown = pictures(grid, controller.signal);
  let chosen = [];
  view.replaceChildren(title, facts, acts,
    h(".scrub", h(".line", kinds, play), slider, where),
    h(".line", h("label.check", same, h("span", "one exposure for all lights")), h("label.check", marked, h("span", "mark saturated pixels")), h("label.check", figures, h("span", "histogram, focus"))),
    grid);

  async function load() {
    try {
      const more = { signal: controller.signal };
      [status, steps] = await Promise.all([get(captureAt(id), more), get(`${captureAt(id)}/steps`, more)]);
    } catch (error) {
      if (!controller.signal.aborted) setContent(facts, h("p.bad", error.message));
      return;
    }
    showFacts();
    if (!steps.some((s) => s.kind === kinds.value)) kinds.value = ["scanline", "pattern"].find((kind) => steps.some((s) => s.kind === kind)) ?? "all";
    pick();
  }

  function showFacts() {
    const c = status;
    const rows = { "State": c.outcome ?? c.state, "Started": clock(c.started), "Duration": seconds(c.seconds), "Steps": number(c.steps), "Frames": `${number(c.frames_written)} of ${number(c.frames_planned)}`, "Missing": number(c.frames_missing) };
    if (c.error) rows.Error = h("span.bad", c.error);
    setContent(facts, definitions(rows));
    acts.replaceChildren(
      h("a.button", { href: `.${captureAt(id)}/archive.tar`, download: "" }, "Download"),
      c.job ? h("a.button", { href: `#jobs/${c.job}` }, "Job") : "",
    );
  }

  function pick() {
    stopFilm();
    chosen = steps.filter((s) => s.lacks.length < S.rig.cameras.length && (kinds.value === "all" || s.kind === kinds.value));
    slider.disabled = chosen.length < 2;
    if (!chosen.length) setContent(where, "no frames of these steps yet");
    slider.max = Math.max(0, chosen.length - 1);
    slider.value = Math.min(slider.value, slider.max);
    white = null;
    play.disabled = chosen.length < 2;
    show();
  }

  function toggleFilm() {
    if (film) return stopFilm();
    setContent(play, "stop");
    film = setInterval(() => {
      if (shown.busy) return; // the next frame waits for the images of this one
      slider.value = (Number(slider.value) + 1) % chosen.length;
      show();
    }, FILM_MS);
    return undefined;
  }

  function stopFilm() {
    clearInterval(film);
    film = 0;
    setContent(play, "film");
  }

  const words = (s) => ({ olat: s.light, pattern: `pattern ${s.pattern}`, scanline: `${s.projector}, row ${s.row}`, all_on: "all lights", tracking: "all projectors" }[s.kind] ?? "dark");

  async function show() {
    const step = chosen[slider.value];
    if (!step) return;
    setContent(where, `${words(step)} · step ${step.index}${step.exposure ? ` · ${seconds(step.exposure)}` : ""}`);
    slider.setAttribute("aria-valuetext", words(step));
    if (same.checked && white === null) await exposure();
    shown.show((camera) => `${captureAt(id)}/frames/${step.index}/${encodeURIComponent(camera)}`, {
      words: words(step), lacks: step.lacks, figures: figures.checked,
      query: [marked.checked ? "mark=true" : "", same.checked && white ? `white=${white}` : ""].filter(Boolean),
    });
  }

  /** The white level for all frames: the brightest of five frames of the first camera. */
  async function exposure() {
    white = 0;
    const some = [0.1, 0.3, 0.5, 0.7, 0.9].map((at) => chosen[Math.floor(at * chosen.length)]);
    const found = await Promise.all(some.map((s) => get(`${captureAt(id)}/frames/${s.index}/${encodeURIComponent(S.rig.cameras[0].name)}.json`, { signal: controller.signal, yields: true }).catch(() => null)));
    white = Math.max(0, ...found.filter(Boolean).map((f) => f.white));
  }

  load();
  return {
    stop() { controller.abort(); stopFilm(); },
    update() {
      if (S.capture?.id === id && status && (S.capture.state !== status.state || S.capture.outcome !== status.outcome)) load();
    },
  };
}


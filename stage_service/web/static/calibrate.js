// Calibration: captures of a board and of spheres, detected corners, the calibrated rig.

import { attempt, steering, underLease } from "./acts.js";
import { captureAt, get, request, stored } from "./api.js";
import { button, clock, h, number, numberIn, setContent, svg, words } from "./dom.js";
import { pictures } from "./pictures.js";
import { S, busy, onEvents } from "./state.js";

const KINDS = {
  boards: ["Board", "One capture per pose: six or more poses in view of every camera, tilted by 30° or more in several directions. Listed for each: corners, tilt, reprojection error.", { lights: [], projectors: [] }],
  diffuse: ["Diffuse sphere", "One capture per place: positions and intensities of the lights.", { projectors: [] }],
  mirror: ["Mirror sphere", "One capture per place, exposed for the highlights: sharper directions.", { projectors: [] }],
};
const LEAST = 8; // corners of a usable image
const LONGER = 40; // magnification of drawn residuals

const kept = { boards: [], diffuse: [], mirror: [] };
const remember = () => Object.assign(kept, JSON.parse(localStorage.getItem(stored("calibration")) ?? "{}"));
const keep = () => localStorage.setItem(stored("calibration"), JSON.stringify(kept));
let pending = null; // {kind, id}: the capture that this page started, in whichever view
let onCapture = () => {}; // of the open view

/** Add the pending capture to the list when it is complete. */
async function collect() {
  if (!pending) return;
  const { kind, id } = pending;
  const { state, outcome } = await get(captureAt(id));
  if (state !== "done" || pending?.id !== id) return;
  pending = null;
  if (outcome !== "completed") return;
  remember();
  kept[kind].push(id);
  keep();
  onCapture(id);
}
onEvents(["capture.over", "fresh"], () => collect().catch(() => {}));

export function open(view) {
  const controller = new AbortController();
  remember();
  const detections = new Map(); // "capture/camera": detected corners
  const numberField = (name, value, more = {}) => h("label", h("span", words(name)), h("input", { name, type: "number", step: "any", value, oninput: () => { detections.clear(); look(); }, ...more }));
  const board = h(".fields", numberField("columns", 9, { step: 1 }), numberField("rows", 7, { step: 1 }), numberField("square_mm", 27), numberField("marker_mm", 21));
  const props = h(".fields", numberField("paper_albedo", "", { placeholder: "unknown" }), numberField("diffuse_albedo", 0.8), numberField("diffuse_radius_mm", 50), numberField("mirror_radius_mm", 50),
    h("label.check", h("input", { type: "checkbox", name: "keep_lens" }), h("span", "keep the nominal lenses")));
  const sections = Object.entries(KINDS).map(([kind, [title, hint, plan]]) => sectionOf(kind, title, hint, plan));
  const grid = h(".grid");
  const cells = pictures(grid, controller.signal);
  const heading = h("h2", "");
  const wrong = h("p.bad");
  const found = h("section", { "aria-live": "polite" });
  const begin = button("Calibrate", () => attempt(solve), { kind: "go" });
  view.append(h("h1", "Calibrate"),
    h(".split", h("div", sections.map((s) => s.element), heading, grid),
      h("aside.after", h("fieldset", h("legend", "the board"), board), h("fieldset", h("legend", "paper and spheres"), props), h(".line", begin), wrong, found)));
  let shown = kept.boards.at(-1) ?? null;
  let solution = null;

  function sectionOf(kind, title, hint, plan) {
    const rows = h("tbody");
    const shoot = steering(`Shoot: ${title.toLowerCase()}`, async () => {
      await underLease();
      const made = await request("POST /captures", { plan });
      pending = { kind, id: made.id };
      await collect();
    }, { lights: true, ready: () => !busy() });
    return {
      kind, rows, shoot,
      element: h("section", h("h2", title), h("p.quiet", hint), h(".wide", { tabindex: "0", role: "region", "aria-label": `captures: ${title}` }, h("table.poses", kind === "boards" ? h("thead", h("tr", h("th", "capture"), S.rig.cameras.map((c) => h("th", c.name)), h("td"))) : "", rows)), h(".line", shoot.element)),
    };
  }

  function list() {
    for (const { kind, rows } of sections) {
      rows.replaceChildren(...kept[kind].map((id) => h("tr", id === shown ? { class: "shown" } : {},
        h("th", { scope: "row" }, button(id, () => { shown = id; list(); show(); }, { kind: "quiet" })),
        ...(kind === "boards" ? S.rig.cameras.map((c) => cell(detections.get(`${id}/${c.name}`), c.name)) : []),
        h("td.n", button("remove", () => { kept[kind] = kept[kind].filter((x) => x !== id); if (shown === id) shown = null; keep(); list(); show(); }, { kind: "quiet", "aria-label": `remove ${id}` })))));
    }
    begin.disabled = !kept.boards.length || solution?.state === "running" || !S.who?.scopes.includes("jobs");
  }

  const cell = (x, name) => h(`td${!x || x.corners >= LEAST ? "" : ".warn"}`, { title: name }, !x ? "…" : x.error ? "–" : `${x.corners}${x.tilt_deg === null ? "" : ` · ${Math.round(x.tilt_deg)}°`}${x.rms_px === null ? "" : ` · ${number(x.rms_px)} px`}`);

  /** Request corners and residuals of each image of the board, once. */
  async function look() {
    const query = new URLSearchParams([...board.querySelectorAll("input")].filter((x) => x.value).map((x) => [x.name, x.value]));
    query.set("calibrated", solution?.rig ?? false);
    for (const id of kept.boards) {
      for (const { name } of S.rig.cameras) {
        const key = `${id}/${name}`;
        if (detections.has(key) || controller.signal.aborted) continue;
        detections.set(key, null);
        detections.set(key, await get(`${captureAt(id)}/board/${encodeURIComponent(name)}?${query}`, { signal: controller.signal }).catch((error) => ({ error: error.message, corners: 0, pixels: [], off: [], rms_px: null, tilt_deg: null })));
        list();
        if (id === shown) show();
      }
    }
  }

  async function show() {
    grid.hidden = heading.hidden = shown === null;
    if (shown === null) return;
    const id = shown;
    const steps = await get(`${captureAt(id)}/steps`, { signal: controller.signal }).catch(() => []);
    const lit = steps.find((s) => s.kind === "all_on") ?? steps.at(-1);
    if (id !== shown || !lit) return;
    setContent(heading, `${id}: camera images${kept.boards.includes(id) ? `; lines: reprojection error of the ${solution?.rig ? "calibrated" : "nominal"} lens, drawn ${LONGER} times as long` : ""}`);
    cells.show((camera) => `${captureAt(id)}/frames/${lit.index}/${encodeURIComponent(camera)}`, { words: "all lights", lacks: lit.lacks, figures: false, query: [], over: (name) => marks(detections.get(`${id}/${name}`)) });
  }

  const marks = (x) => (x?.pixels ?? []).flatMap(([u, v], i) => {
    const [a, b] = x.off[i] ?? [0, 0];
    return [svg("circle", { cx: u, cy: v, r: 3 }), svg("path", { class: "off", d: `M${u} ${v}l${LONGER * a} ${LONGER * b}` })];
  });

  async function solve() {
    const body = { boards: kept.boards, diffuse: kept.diffuse, mirror: kept.mirror, board: {} };
    for (const x of board.querySelectorAll("input")) body.board[x.name] = numberIn(x);
    for (const x of props.querySelectorAll("input")) body[x.name] = x.type === "checkbox" ? x.checked : numberIn(x);
    showSolution(await request("POST /calibration", body));
  }

  function showSolution(result) {
    solution = result;
    setContent(wrong, result.state === "failed" ? result.error : "");
    const cameras = result.stages.find((s) => s.name === "cameras")?.figures;
    const lights = result.stages.find((s) => s.name === "lights")?.figures;
    found.replaceChildren(...[
      result.state === "running" ? h("p.status", `Calibrating since ${clock(result.started)} …`) : null,
      ...(result.state === "running" ? [] : [
        cameras && h("table", h("thead", h("tr", h("th", "camera"), h("th.n", "rms, px"), h("th.n", "± focal"), h("th.n", "± mm"), h("th.n", "poses"))),
          h("tbody", Object.keys(cameras.rms_px).map((n) => h("tr", h("th", { scope: "row" }, n), h(`td.n${cameras.rms_px[n] > 0.3 ? ".warn" : ""}`, number(cameras.rms_px[n])), h("td.n", cameras.lens === "nominal" ? "kept" : `${number(100 * cameras.focal_deviation[n])} %`), h("td.n", cameras.position_deviation_mm[n] ? number(cameras.position_deviation_mm[n]) : "–"), h("td.n", cameras.captures_and_corners[n][0]))))),
        lights && h("p", `${lights.calibrated} of ${S.rig.lights.length} lights were calibrated.`),
        ...result.stages.flatMap((s) => s.warnings.map((w) => h("p.note", w))),
        ...result.stages.flatMap((s) => Object.entries(s.figures.undetermined ?? {}).slice(0, 8).map(([k, why]) => h("p.quiet", `${k}: ${why}`))),
        result.rig && h(".line", h("a.button", { href: "./calibration/rig.json", download: "rig.json" }, "Accept: download the rig file")),
        result.rig && h("p.quiet", "Serve with it (hairstage serve --rig rig.json). To repeat: remove bad captures from the lists, shoot others, calibrate again."),
      ]),
    ].filter(Boolean));
    list();
  }

  async function reload() {
    showSolution(await get("/calibration", { signal: controller.signal }));
    detections.clear();
    look();
  }

  onCapture = (id) => {
    shown = id;
    list();
    show();
    look();
  };
  const onState = () => reload().then(show).catch(() => {});
  const stop = onEvents(["calibration.state"], onState);
  list();
  onState();
  return {
    update() { for (const s of sections) s.shoot.update(); },
    end() { controller.abort(); onCapture = () => {}; stop(); },
  };
}

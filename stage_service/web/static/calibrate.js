// Calibration: captures of a board and of spheres, detected corners, the calibrated rig.

import { attempt, steering, underLease } from "./acts.js";
import { ask, captureAt, get } from "./ask.js";
import { button, clock, h, number, numberIn, say, svg, words } from "./dom.js";
import { pictures } from "./pictures.js";
import { S, busy, events } from "./state.js";

const KINDS = {
  boards: ["Board", "One capture per pose: six or more poses that every camera sees, tilted by 30° or more in several directions. Listed for each: corners, tilt, reprojection error.", { lights: [], projectors: [] }],
  diffuse: ["Diffuse sphere", "One capture per place: positions and intensities of the lights.", { projectors: [] }],
  mirror: ["Mirror sphere", "One capture per place, exposed for the highlights: sharper directions.", { projectors: [] }],
};
const LEAST = 8; // corners that count
const LONGER = 40; // times the residuals are drawn

const kept = { boards: [], diffuse: [], mirror: [] };
const remember = () => Object.assign(kept, JSON.parse(localStorage.getItem("calibration") ?? "{}"));
const keep = () => localStorage.setItem("calibration", JSON.stringify(kept));
let waiting = null; // {kind, id}: what is shot for this page, whichever view it shows meanwhile
let came = () => {}; // for the view that is open

/** Keep what was shot, once it is complete. */
async function learn() {
  if (!waiting) return;
  const { kind, id } = waiting;
  const { state, outcome } = await get(captureAt(id));
  if (state !== "done" || waiting?.id !== id) return;
  waiting = null;
  if (outcome !== "completed") return;
  remember();
  kept[kind].push(id);
  keep();
  came(id);
}
for (const kind of ["capture.over", "fresh"]) events.addEventListener(kind, () => learn().catch(() => {}));

export function open(view) {
  const controller = new AbortController();
  remember();
  const seen = new Map(); // "capture/camera": what it shows of the board
  const number_ = (name, value, more = {}) => h("label", h("span", words(name)), h("input", { name, type: "number", step: "any", value, oninput: () => { seen.clear(); look(); }, ...more }));
  const board = h(".fields", number_("columns", 9, { step: 1 }), number_("rows", 7, { step: 1 }), number_("square_mm", 27), number_("marker_mm", 21));
  const props = h(".fields", number_("paper_albedo", "", { placeholder: "not known" }), number_("diffuse_albedo", 0.8), number_("diffuse_radius_mm", 50), number_("mirror_radius_mm", 50),
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
      const made = await ask("POST /captures", { plan });
      waiting = { kind, id: made.id };
      await learn();
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
        ...(kind === "boards" ? S.rig.cameras.map((c) => cell(seen.get(`${id}/${c.name}`), c.name)) : []),
        h("td.n", button("remove", () => { kept[kind] = kept[kind].filter((x) => x !== id); if (shown === id) shown = null; keep(); list(); show(); }, { kind: "quiet", "aria-label": `remove ${id}` })))));
    }
    begin.disabled = !kept.boards.length || solution?.state === "running" || !S.who?.scopes.includes("jobs");
  }

  const cell = (x, name) => h(`td${!x || x.corners >= LEAST ? "" : ".warn"}`, { title: name }, !x ? "…" : x.error ? "–" : `${x.corners}${x.tilt_deg === null ? "" : ` · ${Math.round(x.tilt_deg)}°`}${x.rms_px === null ? "" : ` · ${number(x.rms_px)} px`}`);

  /** Each picture of the board, once: the corners, and how far each is off. */
  async function look() {
    const query = new URLSearchParams([...board.querySelectorAll("input")].filter((x) => x.value).map((x) => [x.name, x.value]));
    query.set("calibrated", solution?.rig ?? false);
    for (const id of kept.boards) {
      for (const { name } of S.rig.cameras) {
        const key = `${id}/${name}`;
        if (seen.has(key) || controller.signal.aborted) continue;
        seen.set(key, null);
        seen.set(key, await get(`${captureAt(id)}/board/${encodeURIComponent(name)}?${query}`, { signal: controller.signal }).catch((error) => ({ error: error.message, corners: 0, pixels: [], off: [], rms_px: null, tilt_deg: null })));
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
    say(heading, `${id}: what the cameras see${kept.boards.includes(id) ? `; lines: reprojection error of the ${solution?.rig ? "calibrated" : "nominal"} lens, drawn ${LONGER} times as long` : ""}`);
    cells.show((camera) => `${captureAt(id)}/frames/${lit.index}/${encodeURIComponent(camera)}`, { words: "all lights", lacks: lit.lacks, figures: false, query: [], over: (name) => marks(seen.get(`${id}/${name}`)) });
  }

  const marks = (x) => (x?.pixels ?? []).flatMap(([u, v], i) => {
    const [a, b] = x.off[i] ?? [0, 0];
    return [svg("circle", { cx: u, cy: v, r: 3 }), svg("path", { class: "off", d: `M${u} ${v}l${LONGER * a} ${LONGER * b}` })];
  });

  async function solve() {
    const body = { boards: kept.boards, diffuse: kept.diffuse, mirror: kept.mirror, board: {} };
    for (const x of board.querySelectorAll("input")) body.board[x.name] = numberIn(x);
    for (const x of props.querySelectorAll("input")) body[x.name] = x.type === "checkbox" ? x.checked : numberIn(x);
    tell(await ask("POST /calibration", body));
  }

  function tell(view_) {
    solution = view_;
    say(wrong, view_.state === "failed" ? view_.error : "");
    const cameras = view_.stages.find((s) => s.name === "cameras")?.figures;
    const lights = view_.stages.find((s) => s.name === "lights")?.figures;
    found.replaceChildren(...[
      view_.state === "running" ? h("p.said", `Calibrating since ${clock(view_.started)} …`) : null,
      ...(view_.state === "running" ? [] : [
        cameras && h("table", h("thead", h("tr", h("th", "camera"), h("th.n", "rms, px"), h("th.n", "± focal"), h("th.n", "± mm"), h("th.n", "poses"))),
          h("tbody", Object.keys(cameras.rms_px).map((n) => h("tr", h("th", { scope: "row" }, n), h(`td.n${cameras.rms_px[n] > 0.3 ? ".warn" : ""}`, number(cameras.rms_px[n])), h("td.n", cameras.lens === "nominal" ? "kept" : `${number(100 * cameras.focal_deviation[n])} %`), h("td.n", cameras.position_deviation_mm[n] ? number(cameras.position_deviation_mm[n]) : "–"), h("td.n", cameras.captures_and_corners[n][0]))))),
        lights && h("p", `${lights.calibrated} of ${S.rig.lights.length} lights were calibrated.`),
        ...view_.stages.flatMap((s) => s.warnings.map((w) => h("p.note", w))),
        ...view_.stages.flatMap((s) => Object.entries(s.figures.undetermined ?? {}).slice(0, 8).map(([k, why]) => h("p.quiet", `${k}: ${why}`))),
        view_.rig && h(".line", h("a.button", { href: "/calibration/rig.json", download: "rig.json" }, "Accept: download the rig file")),
        view_.rig && h("p.quiet", "Serve with it (hairstage serve --rig rig.json). To repeat: remove bad captures from the lists, shoot others, calibrate again."),
      ]),
    ].filter(Boolean));
    list();
  }

  async function ask_() {
    tell(await get("/calibration", { signal: controller.signal }));
    seen.clear();
    look();
  }

  const onState = () => ask_().then(show).catch(() => {});
  came = (id) => {
    shown = id;
    list();
    show();
    look();
  };
  events.addEventListener("calibration.state", onState);
  list();
  onState();
  return {
    update() { for (const s of sections) s.shoot.update(); },
    end() { controller.abort(); came = () => {}; events.removeEventListener("calibration.state", onState); },
  };
}

// Devices, lease, audit log.

import { attempt } from "./acts.js";
import { get, request } from "./api.js";
import { button, bytes, clock, h, keyed, local, number, setContent, words } from "./dom.js";
import { doubt, lampState, lampWords } from "./lamps.js";
import { S, load, onEvents } from "./state.js";

const RELOAD_ON = ["capture.state", "stage.lamps", "stage.lease", "stage.blackout", "fresh", "queue.held"];
const LIT = ["lights", "projectors"]; // devices that emit light

export function open(view) {
  const health = h("dl.facts");
  const problems = h("ul.problems");
  const devices = h(".grid");
  const age = h("p.quiet");
  const rows = h("tbody");
  const lease = h(".line");
  devices.style.setProperty("--cell", "16rem");
  view.append(
    h("h1", "The stage"), health, problems,
    h("section.devices", h(".line", h("h2", "Devices"), button("Query again", loadDevices, { kind: "quiet" }), age), devices),
    h("section", h("h2", "Who steers"), lease),
    h("section", h("h2", "Audit log"), h(".wide", { tabindex: "0", role: "region", "aria-label": "audit log" }, h("table", h("thead", h("tr", ["time", "who", "action", "subject", "result", "reason"].map((x) => h("th", x)))), rows))),
  );

  let all = []; // the devices at the last query
  async function loadDevices() {
    const found = await attempt(() => get("/devices"));
    if (!found) return;
    const { cameras = {}, safety, age_s, projector_power: power = {}, ...single } = found;
    setContent(age, age_s === null ? "not queried yet" : `queried ${number(Math.round(age_s))} s ago`);
    all = [...Object.entries(single), ...Object.entries(cameras).map(([k, v]) => [`camera ${k}`, v]), ...Object.entries(power).map(([k, v]) => [`power of ${k}`, v])].filter(([, v]) => v && typeof v === "object");
    showDevices();
  }

  // A responding link does not prove that its lamps are dark.
  const doubts = (kind) => (LIT.includes(kind) ? doubt(S.health, kind) : null);

  function showDevices() {
    keyed(devices, all, ([k]) => k, () => {
      const name = h("h3");
      const state = h("p");
      const figures = h("dl.facts");
      const element = h("article.device", name, state, figures);
      return { element, update([kind, d]) {
        const but = doubts(kind);
        const bad = d.state === "unreachable" || (but && lampState(S.health) !== "accepted");
        element.className = `device ${bad ? "unreachable" : d.state === "ok" ? "" : "busy"}`;
        setContent(name, kind);
        setContent(state, h(bad ? "b.bad" : "span", but ? `${d.state === "ok" ? "responds" : d.state}, ${but}` : d.state), d.error ? ` ${d.error}` : "");
        const shown = { ...d, ...d.since_start };
        setContent(figures, ...Object.entries(shown).filter(([k]) => !["name", "state", "error", "since_start"].includes(k)).map(([k, v]) => h("div", h("dt", words(k)), h("dd", Array.isArray(v) ? v.map((x) => (typeof x === "object" ? JSON.stringify(x) : x)).join(", ") : String(v)))));
      } };
    });
  }

  async function loadAudit() {
    const found = await attempt(() => get("/audit?limit=200"));
    if (!found) return;
    rows.replaceChildren(...found.reverse().map((a) => h("tr", h("td.n", clock(a.time)), h("td", a.who), h("td", a.action), h("td", a.subject), h(["ok", "dark", "completed"].includes(a.result) ? "td" : "td.warn", a.result), h("td", local(a.detail)))));
  }

  let timer = 0;
  const onEvent = () => { clearTimeout(timer); timer = setTimeout(() => { loadAudit(); loadDevices(); }, 300); };
  const stop = onEvents(RELOAD_ON, onEvent);
  loadDevices();
  loadAudit();

  function update() {
    const x = S.health;
    if (!x) return;
    showDevices();
    const lamps = lampWords(x);
    const facts = { "Service": `${x.status}, version ${x.version}`, "Rig": x.rig, "Disk": `${bytes(x.disk_free_bytes)} free`, "Worker": x.worker ? "runs" : "none runs: jobs stay queued", "Lamps": x.problems.includes(x.lamps_detail) ? lamps.fact : `${lamps.fact}: ${lamps.detail}`, "Root folder": x.root };
    setContent(health, ...Object.entries(facts).map(([k, v]) => h(v.length > 40 ? "div.long" : "div", h("dt", k), h("dd", v))));
    setContent(problems, ...x.problems.map((text) => h("li", text)));
    const held = S.lease.holder;
    setContent(lease, held === null ? "The lease is free." : `${held}, until ${clock(S.lease.expires)}.`,
      held !== null && S.who?.scopes.includes("admin") ? button("end this lease", () => attempt(async () => { await request("DELETE /lease?force=true"); await load.lease(); }), { kind: "quiet" }) : "");
  }
  return { update, end() { clearTimeout(timer); stop(); } };
}

// Devices, lease, audit log.

import { attempt } from "./acts.js";
import { ask, get } from "./ask.js";
import { button, bytes, clock, h, keyed, local, number, say, words } from "./dom.js";
import { doubt, lampState, lampWords } from "./lamps.js";
import { S, events, load } from "./state.js";

const TOLD = ["capture.state", "stage.lamps", "stage.lease", "stage.blackout", "fresh", "queue.held"];
const LIT = ["lights", "projectors"]; // what can be left on

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
    h("section.devices", h(".line", h("h2", "Devices"), button("Query again", askAll, { kind: "quiet" }), age), devices),
    h("section", h("h2", "Who steers"), lease),
    h("section", h("h2", "Audit log"), h(".wide", { tabindex: "0", role: "region", "aria-label": "audit log" }, h("table", h("thead", h("tr", ["time", "who", "action", "subject", "result", "reason"].map((x) => h("th", x)))), rows))),
  );

  let all = []; // the devices, as they were seen last
  async function askAll() {
    const found = await attempt(() => get("/devices"));
    if (!found) return;
    const { cameras = {}, safety, age_s: seen, projector_power: power = {}, ...single } = found;
    say(age, seen === null ? "not queried yet" : `queried ${number(Math.round(seen))} s ago`);
    all = [...Object.entries(single), ...Object.entries(cameras).map(([k, v]) => [`camera ${k}`, v]), ...Object.entries(power).map(([k, v]) => [`power of ${k}`, v])].filter(([, v]) => v && typeof v === "object");
    tellDevices();
  }

  // A link that answers does not make its lamps dark.
  const doubts = (kind) => (LIT.includes(kind) ? doubt(S.health, kind) : null);

  function tellDevices() {
    keyed(devices, all, ([k]) => k, () => {
      const name = h("h3");
      const state = h("p");
      const figures = h("dl.facts");
      const element = h("article.device", name, state, figures);
      return { element, tell([kind, d]) {
        const but = doubts(kind);
        const bad = d.state === "unreachable" || (but && lampState(S.health) !== "accepted");
        element.className = `device ${bad ? "unreachable" : d.state === "ok" ? "" : "asked"}`;
        say(name, kind);
        say(state, h(bad ? "b.bad" : "span", but ? `${d.state === "ok" ? "responds" : d.state}, ${but}` : d.state), d.error ? ` ${d.error}` : "");
        const told = { ...d, ...d.since_start };
        say(figures, ...Object.entries(told).filter(([k]) => !["name", "state", "error", "since_start"].includes(k)).map(([k, v]) => h("div", h("dt", words(k)), h("dd", Array.isArray(v) ? v.map((x) => (typeof x === "object" ? JSON.stringify(x) : x)).join(", ") : String(v)))));
      } };
    });
  }

  async function askAudit() {
    const found = await attempt(() => get("/audit?limit=200"));
    if (!found) return;
    rows.replaceChildren(...found.reverse().map((a) => h("tr", h("td.n", clock(a.time)), h("td", a.who), h("td", a.action), h("td", a.subject), h(["ok", "dark", "completed"].includes(a.result) ? "td" : "td.warn", a.result), h("td", local(a.detail)))));
  }

  let timer = 0;
  const onEvent = () => { clearTimeout(timer); timer = setTimeout(() => { askAudit(); askAll(); }, 300); };
  for (const kind of TOLD) events.addEventListener(kind, onEvent);
  askAll();
  askAudit();

  function update() {
    const x = S.health;
    if (!x) return;
    tellDevices();
    const lamps = lampWords(x);
    const facts = { "Service": `${x.status}, version ${x.version}`, "Rig": x.rig, "Disk": `${bytes(x.disk_free_bytes)} free`, "Worker": x.worker ? "runs" : "none runs: jobs stay queued", "Lamps": x.problems.includes(x.lamps_detail) ? lamps.fact : `${lamps.fact}: ${lamps.detail}`, "Root folder": x.root };
    say(health, ...Object.entries(facts).map(([k, v]) => h(v.length > 40 ? "div.long" : "div", h("dt", k), h("dd", v))));
    say(problems, ...x.problems.map((text) => h("li", text)));
    const held = S.lease.holder;
    say(lease, held === null ? "Nobody holds the lease." : `${held}, until ${clock(S.lease.expires)}.`,
      held !== null && S.who?.scopes.includes("admin") ? button("end this lease", () => attempt(async () => { await ask("DELETE /lease?force=true"); await load.lease(); }), { kind: "quiet" }) : "");
  }
  return { update, end() { clearTimeout(timer); for (const kind of TOLD) events.removeEventListener(kind, onEvent); } };
}

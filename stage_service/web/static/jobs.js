// Jobs: progress, error against time, warnings and files.

import { attempt } from "./acts.js";
import { get, request } from "./api.js";
import { button, bytes, clock, definitions, h, keyed, local, number, percent, seconds, setContent, svg, words } from "./dom.js";
import { S, changed, load, onEvents } from "./state.js";

export function open(view, [requestedId]) {
  const list = h(".list", { role: "group", "aria-label": "jobs" });
  const none = h("p.quiet");
  const detail = h("section");
  let shown = null;
  view.append(h(".side", h("section", { "aria-label": "jobs" }, h("h1", "Jobs"), none, list), detail));
  load.jobs();

  function choose(id) {
    shown?.stop();
    shown = { id, ...jobOf(detail, id) };
    history.replaceState(null, "", `#jobs/${id}`);
    changed();
  }

  function update() {
    setContent(none, S.jobsProblem ?? (S.jobs?.length ? "" : "No jobs. A capture whose plan names a pipeline enqueues one when it is complete."));
    keyed(list, S.jobs ?? [], (j) => j.id, (j) => {
      const name = h("span");
      const share = h("progress", { max: 1, "aria-label": "done" });
      return { element: h("button", { type: "button", onclick: () => choose(j.id) }, name, share), update(x) {
        setContent(name, `${x.pipeline} `, h("br"), h(`small${x.outcome === "failed" ? ".bad" : ""}`, `${x.outcome ?? x.state}${x.progress && x.state === "running" ? `: ${words(x.progress.step)}` : ""} · ${clock(x.created)}`));
        share.hidden = x.state !== "running";
        share.value = x.progress?.share ?? 0;
      } };
    });
    if (!shown && (requestedId || S.jobs?.length)) choose(requestedId ?? S.jobs[0].id);
    shown?.update();
  }
  return { update, end: () => shown?.stop() };
}

function jobOf(view, id) {
  const facts = h("dl.facts");
  const title = h("h2.title", id);
  const wrong = h("p.bad");
  const what = h("p.status");
  const meter = h("progress", { max: 1, "aria-label": "done" });
  const acts = h(".line");
  const strands = h("a.button", { hidden: true }, "View the strands");
  const curves = h(".grid");
  const stages = h("tbody");
  const timed = h("section", h("h2", "Stages"), h("table", h("thead", h("tr", h("th", "stage"), h("th.n", "seconds"), h("th", "warnings"))), stages));
  const files = h("section");
  const page = h("section");
  curves.style.setProperty("--cell", "18rem");
  view.replaceChildren(title, facts, wrong, what, meter, acts, curves, timed, page, files);
  let last = "";
  let job = null;
  let measured = "";

  const onEvent = ({ detail }) => { if (detail.job === id) refresh(); };
  const stop = onEvents(["job.state", "job.progress"], onEvent);

  async function refresh() {
    const known = S.jobs?.find((j) => j.id === id) ?? await attempt(() => get(`/jobs/${id}`));
    if (!known) return;
    job = known;
    update();
  }

  /** Load report and files, once after each step and at the end. */
  async function look() {
    const step = `${job.state}/${job.outcome}/${job.progress?.step}`;
    if (step === last) return;
    last = step;
    const list = await get(`/jobs/${id}/artifacts`).catch(() => []);
    if (list.some((f) => f.path === "report.json")) reportOf(await get(`/jobs/${id}/report`));
    if (step === last) filesOf(list);
  }

  /** Seconds left, extrapolated from the completed share. */
  function timeLeft() {
    const share = job.progress?.share ?? 0;
    if (job.state !== "running" || !job.started || share < 0.02) return null;
    return (((Date.now() - new Date(job.started)) / 1000) * (1 - share)) / share;
  }

  function update() {
    if (!job) { refresh(); return; }
    job = S.jobs?.find((j) => j.id === id) ?? job;
    const p = job.progress;
    const rows = {
      "Pipeline": job.pipeline, "State": job.outcome ?? job.state, "Capture": job.capture.split("/").at(-1), "Model": job.model.split("/").at(-1),
      "Started": clock(job.started), "Duration": job.finished && job.started ? seconds((new Date(job.finished) - new Date(job.started)) / 1000) : "–",
      ...(job.state === "running" ? { "Time left": `about ${seconds(timeLeft())}` } : {}),
    };
    setContent(facts, definitions(rows));
    setContent(wrong, job.error ? `${local(job.error.detail)} (${job.error.type})` : "");
    wrong.hidden = !job.error;
    setContent(what, job.state === "running" && p ? `${words(p.step)} (${p.steps.indexOf(p.step) + 1} of ${p.steps.length}): ${p.what}` : job.state === "queued" ? "Queued until a worker is free." : "");
    meter.hidden = job.state !== "running";
    what.hidden = job.state === "done";
    look().catch(() => { last = ""; });
    meter.value = p?.share ?? 0;
    meter.title = percent(p?.share ?? 0);
    const may = S.who?.scopes.includes("jobs");
    const key = `${job.state}/${job.outcome}/${may}`;
    if (acts.dataset.key === key) return;
    acts.dataset.key = key;
    strands.href = `./view#model=${encodeURIComponent(job.model.split("/").at(-1))}`;
    acts.replaceChildren(
      ...(job.state !== "done" && may ? [button("Cancel", () => attempt(async () => { await request(`DELETE /jobs/${id}`); load.jobs(); }))] : []),
      ...(job.state === "done" && job.outcome !== "succeeded" && may ? [button("Run it again", () => attempt(again))] : []),
      strands,
      h("a.button", { href: `./models/${encodeURIComponent(job.model.split("/").at(-1))}/archive.tar`, download: "" }, "Download the model"),
    );
  }

  async function again() {
    const made = await request("POST /jobs", { capture: job.capture.split("/").at(-1), model: job.model.split("/").at(-1), pipeline: { name: job.pipeline, options: job.options, priority: job.priority, retries: job.retries, timeout_s: job.timeout_s } });
    await load.jobs();
    location.hash = `#jobs/${made.id}`;
    location.reload();
  }

  function reportOf(report) {
    const text = JSON.stringify(report.stages.map((s) => [s.name, s.series.length]));
    if (text === measured) return;
    measured = text;
    stages.replaceChildren(...report.stages.map((s) => h("tr", h("th", { scope: "row" }, words(s.name)), h("td.n", number(s.seconds)), h("td", s.warnings.map((w) => h("p.warn", w))))));
    curves.replaceChildren(...report.stages.flatMap((s) => s.series.filter((x) => x.points.length > 1).map((x) => curve(`${words(s.name)}: ${x.name}`, x))));
  }

  function filesOf(list) {
    const link = (path) => `./jobs/${id}/artifacts/${path.split("/").map(encodeURIComponent).join("/")}`;
    const has = (path) => list.some((f) => f.path === path);
    page.replaceChildren(...(has("index.html") ? [h("h2", "Report"), h("p", h("a", { href: link("index.html"), target: "_blank", rel: "noopener" }, "open the report in a new page"))] : []),
      ...["relit.webp", "relit.png", "comparison.png"].filter(has).map((f) => h("figure", h("img", { src: link(f), alt: f, loading: "lazy" }), h("figcaption", f))));
    strands.hidden = !has("strands.npz");
    timed.hidden = stages.childElementCount === 0;
    files.hidden = list.length === 0;
    files.replaceChildren(h("details", h("summary", `Files (${list.length})`), h("table", h("tbody", list.map((f) => h("tr", h("td", h("a", { href: link(f.path), download: "" }, f.path)), h("td.n", bytes(f.bytes))))))));
  }

  refresh();
  return { update, stop };
}

/** Error over run time; logarithmic if the error spans more than a factor of 10. */
function curve(title, series) {
  const points = series.points.filter(([, e]) => Number.isFinite(e));
  const [width, height, pad] = [340, 170, 60];
  const errors = points.map(([, e]) => e);
  const log = Math.min(...errors) > 0 && Math.max(...errors) / Math.min(...errors) > 10;
  const f = log ? Math.log10 : (x) => x;
  const low = log ? f(Math.min(...errors)) : Math.min(0, ...errors);
  const high = Math.max(...errors.map(f));
  const end = Math.max(...points.map(([t]) => t)) || 1;
  const x = (t) => pad + ((width - pad - 12) * t) / end;
  const y = (e) => height - 26 - ((height - 44) * (f(e) - low)) / (high - low || 1);
  const [first, final] = [errors[0], errors.at(-1)].map((e) => Math.min(height - 28, y(e) + 4));
  const apart = Math.abs(first - final) < 12 ? (first < final ? -6 : 6) : 0; // keeps the two labels apart
  const text = (at, up, words_, anchor) => svg("text", { x: at, y: up, "text-anchor": anchor }, words_);
  const description = `${title}: ${series.error} ${number(errors[0])} at the start, ${number(errors.at(-1))} after ${seconds(points.at(-1)[0])}`;
  return h("figure", svg("svg", { class: "curve", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": description },
    svg("path", { class: "axis", d: `M${pad} 12V${height - 26}H${width - 8}` }),
    svg("path", { class: "data", d: `M${points.map(([t, e]) => `${x(t).toFixed(1)} ${y(e).toFixed(1)}`).join("L")}` }),
    text(pad - 5, first + apart, number(errors[0]), "end"), text(pad - 5, final - apart, number(errors.at(-1)), "end"),
    text(width - 8, height - 10, seconds(end), "end"), text(pad, height - 10, "0 s", "start")),
    h("figcaption", `${title} · ${series.error}${log ? " (log scale)" : ""}`));
}

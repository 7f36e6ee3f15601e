// The service's events, for as long as the page is open: over dead networks and restarts.
//
// `fetch` instead of `EventSource`: it tells what status a refusal had, and what the service sends to
// keep the line alive, so that a line that is dead and does not say so is noticed.

import { login } from "./ask.js";

const SILENCE_MS = 22_000; // the service says something every 15 s
const PAUSES_MS = [500, 1000, 2000, 4000];

/** Follow the events; `on.event(kind, data)`, `on.up()` when a line is new, `on.down()` when it is lost. */
export function follow(on) {
  let stop = null;
  let tries = 0;
  let waiting = 0;

  async function line() {
    const abort = new AbortController();
    stop = abort;
    let silence = setTimeout(() => abort.abort(), SILENCE_MS);
    const heard = () => {
      clearTimeout(silence);
      silence = setTimeout(() => abort.abort(), SILENCE_MS);
    };
    try {
      const answer = await fetch("/events", { signal: abort.signal, cache: "no-store", credentials: "same-origin" });
      if (answer.status === 401) {
        login.dispatchEvent(new Event("over"));
        return "over";
      }
      if (!answer.ok) throw new Error(`events: HTTP ${answer.status}`);
      tries = 0;
      on.up();
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let rest = "";
      for (;;) {
        const { value, done } = await reader.read();
        if (done) return "lost";
        heard();
        const blocks = (rest + value.replaceAll("\r\n", "\n")).split("\n\n");
        rest = blocks.pop();
        for (const block of blocks) tell(block);
      }
    } catch {
      return "lost";
    } finally {
      clearTimeout(silence);
      abort.abort();
    }
  }

  function tell(block) {
    const data = block.split("\n").filter((x) => x.startsWith("data:")).map((x) => x.slice(5)).join("\n");
    if (!data) return;
    const event = JSON.parse(data);
    on.event(event.kind, event.data);
  }

  async function go() {
    if (stop) return;
    const ended = await line();
    stop = null;
    if (ended === "over") return;
    on.down();
    if (document.hidden) return;
    waiting = setTimeout(go, PAUSES_MS[Math.min(tries++, PAUSES_MS.length - 1)]);
  }

  // A browser keeps few connections to one host: a page that nobody sees gives its own back.
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) stop?.abort();
    else {
      clearTimeout(waiting);
      go();
    }
  });
  addEventListener("online", () => { clearTimeout(waiting); go(); });
  go();
  return { again: go };
}

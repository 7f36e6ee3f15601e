// The service's event stream, reconnected after failures and restarts.
//
// `fetch` instead of `EventSource`: it has the status of a refusal, and the comments that the service sends
// every second, so that a line that is dead without having ended is noticed.

import { service, tell } from "./ask.js";

const SILENCE_MS = 8000;
const PAUSES_MS = [500, 1000, 2000, 4000];
const REFUSED_MS = 1000;

/** Follow the events: `on.event(kind, data)`, `on.up()` when a line is new, `on.down()` when it is lost,
 * `await on.refused(why)` every second while the service refuses one. */
export function follow(on) {
  let stop = null; // ends the line; not null while there is one, or one is tried
  let tries = 0;
  let waiting = 0;

  async function line(abort) {
    let silence = setTimeout(() => abort.abort(), SILENCE_MS);
    const heard = () => {
      clearTimeout(silence);
      silence = setTimeout(() => abort.abort(), SILENCE_MS);
      tell("word");
    };
    try {
      const answer = await fetch("/events", { signal: abort.signal, cache: "no-store", credentials: "same-origin" });
      if (answer.status === 401) {
        tell("over");
        return { over: true };
      }
      if (!answer.ok) {
        const { detail } = await answer.json().catch(() => ({}));
        return { refused: detail ?? `HTTP ${answer.status}` };
      }
      tries = 0;
      heard();
      on.up();
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let rest = "";
      for (;;) {
        const { value, done } = await reader.read();
        if (done) return {};
        heard();
        const blocks = (rest + value.replaceAll("\r\n", "\n")).split("\n\n");
        rest = blocks.pop();
        for (const block of blocks) read(block);
      }
    } catch {
      return {};
    } finally {
      clearTimeout(silence);
      abort.abort();
    }
  }

  function read(block) {
    const data = block.split("\n").filter((x) => x.startsWith("data:")).map((x) => x.slice(5)).join("\n");
    if (!data) return;
    const event = JSON.parse(data);
    on.event(event.kind, event.data);
  }

  async function go() {
    if (stop) return;
    stop = new AbortController();
    const ended = await line(stop);
    if (ended.refused) await on.refused(ended.refused);
    else if (!ended.over) on.down();
    stop = null;
    if (ended.over || document.hidden) return;
    waiting = setTimeout(go, ended.refused ? REFUSED_MS : PAUSES_MS[Math.min(tries++, PAUSES_MS.length - 1)]);
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
  service.addEventListener("yield all", () => stop?.abort());
  go();
}

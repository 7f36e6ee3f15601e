// The service's event stream, reconnected after failures and restarts.
//
// `fetch`, not `EventSource`: it gives the status of a refusal, and the comments that the service sends every second,
// by which a dead connection is detected.

import { emit, service } from "./api.js";

const SILENCE_MS = 8000;
const PAUSES_MS = [500, 1000, 2000, 4000];
const REFUSED_MS = 1000;

/** Follow the events: `on.event(kind, data)`, `on.up()` after each connection, `on.down()` when it is lost,
 * `await on.refused(why)` every second while the service refuses it. */
export function follow(on) {
  let stop = null; // aborts the connection or its attempt; null: none
  let tries = 0;
  let waiting = 0;

  async function line(abort) {
    let silence = setTimeout(() => abort.abort(), SILENCE_MS);
    const onContact = () => {
      clearTimeout(silence);
      silence = setTimeout(() => abort.abort(), SILENCE_MS);
      emit("contact");
    };
    try {
      const response = await fetch("./events", { signal: abort.signal, cache: "no-store", credentials: "same-origin" });
      if (response.status === 401) {
        emit("logged out");
        return { over: true };
      }
      if (!response.ok) {
        const { detail } = await response.json().catch(() => ({}));
        return { refused: detail ?? `HTTP ${response.status}` };
      }
      tries = 0;
      onContact();
      on.up();
      const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
      let rest = "";
      for (;;) {
        const { value, done } = await reader.read();
        if (done) return {};
        onContact();
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

  // A browser opens few connections to a host: a hidden page closes its own.
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

// A black screen, which does not light the subject. A key, a touch or an alarm closes it.

import { h } from "./dom.js";
import { pressed } from "./blackout.js";
import { S, busy, onChange, silence } from "./state.js";

let cover = null;

export function blackScreen() {
  if (cover) return end();
  const before = document.activeElement;
  const word = h("p", "");
  cover = h(".black", { role: "dialog", "aria-label": "black screen: press a key or touch to close", tabindex: "0" }, word);
  cover.before_ = before;
  cover.addEventListener("pointerdown", end);
  cover.addEventListener("keydown", (event) => {
    if (/^(F\d+|Tab|Shift|Control|Alt|Meta)$/.test(event.key)) return;
    event.preventDefault();
    end();
  });
  document.body.append(cover);
  cover.focus();
  const was = busy();
  const stop = onChange(() => {
    word.textContent = busy() && S.capture.state === "running" ? `${S.capture.step} / ${S.capture.steps}` : "";
    if (S.loggedOut || silence() || pressed?.going || S.health?.latch || S.failed || (was && !busy())) end();
  });
  cover.stop = stop;
  return undefined;
}

function end() {
  cover?.stop();
  cover?.remove();
  cover?.before_?.focus?.();
  cover = null;
}

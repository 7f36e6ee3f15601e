// What people do, whichever view they are in.

import { ask, captureAt } from "./ask.js";
import { button, h, seconds } from "./dom.js";
import { S, busy, load, refused, takeLease, unlit } from "./state.js";

const notices = document.getElementById("notices");

/** Show a sentence for a while. */
export function notice(text, kind = "") {
  const made = h(`p.notice${kind ? "." + kind : ""}`, text);
  notices.append(made);
  setTimeout(() => made.remove(), kind === "bad" ? 15_000 : 6000);
}

const LEFT = new Error("left without a name");

/** Do what a button is for; a refusal is shown. */
export async function attempt(work) {
  try {
    return await work();
  } catch (error) {
    if (error === LEFT) return undefined;
    notice(error.status === 401 ? "Log in again." : error.message, "bad");
    return undefined;
  }
}

export async function abort() {
  if (!busy()) return notice("No capture is running.");
  const { id } = S.capture;
  await attempt(() => ask(`POST ${captureAt(id)}/abort`));
  return load.capture(id).catch(() => {});
}

export function left(c) {
  if (c.state === "aborting") return "ends after this step";
  if (c.state === "finishing") return "nothing more is lit";
  if (c.state === "paused") return "lights off";
  const s = c.progress?.seconds_left;
  return s === null || s === undefined ? "time left: not known yet" : `${seconds(s)} left`;
}

/** Who steers, as the others see it. Raises `LEFT` where nobody says. */
export async function askName() {
  const known = (localStorage.getItem("name") ?? S.who?.name ?? "").trim();
  if (known) return known;
  return new Promise((done, left_) => {
    const field = h("input", { name: "holder", required: true, maxlength: 100, pattern: ".*\\S.*", title: "a name", autocomplete: "name" });
    const box = h("dialog", { "aria-label": "who steers" }, h("form", { onsubmit: (event) => {
      event.preventDefault();
      localStorage.setItem("name", field.value.trim());
      done(field.value.trim());
      box.close();
    } }, h("label", "Your name, as the others see it", field), h(".line", h("button.go", "Steer"), button("Cancel", () => box.close()))));
    box.addEventListener("close", () => { box.remove(); left_(LEFT); }); // nothing, after `done`
    document.body.append(box);
    box.showModal();
  });
}

/** A button that steers: disabled, with the reason as its title, while this page may not; `lights`: it has lamps lit. */
export function steering(text, work, { ready = () => true, lights = false, ...more } = {}) {
  const made = button(text, () => attempt(work), more);
  return {
    element: made,
    update() {
      const why = refused() ?? (lights ? unlit() : null);
      made.disabled = why !== null || !ready();
      made.title = why ?? more.title ?? "";
    },
  };
}

/** Steer alone from here on, unless this page does so already. */
export async function underLease() {
  await takeLease(await askName());
}

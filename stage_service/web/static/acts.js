// Actions shared by all views.

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
  const name = await nameIn("Your name, as the others see it", "Steer");
  localStorage.setItem("name", name);
  return name;
}

/** A name that the person types. Raises `LEFT` where they type none. */
export async function nameIn(label, go) {
  const field = h("input", { name: "holder", required: true, maxlength: 100, pattern: ".*\\S.*", title: "a name", autocomplete: "name" });
  await confirmed(label, [h("label", label, field)], go);
  return field.value.trim();
}

/** Returns once the person has confirmed `content` by the button `go`. Raises `LEFT` where they have not. Not modal, and
 * not the browser's own, which would keep them from Blackout. */
export function confirmed(label, content, go) {
  return new Promise((done, left_) => {
    const box = h("dialog", { "aria-label": label, onkeydown: (event) => { if (event.key === "Escape") box.close(); } }, h("form", { onsubmit: (event) => {
      event.preventDefault();
      done();
      box.close();
    } }, content, h(".line", h("button.go", go), button("Cancel", () => box.close()))));
    box.addEventListener("close", () => { box.remove(); left_(LEFT); }); // nothing, after `done`
    for (const other of document.querySelectorAll("dialog")) other.close();
    document.body.append(box);
    box.show();
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

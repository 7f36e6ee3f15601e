// Actions shared by all views.

import { captureAt, request } from "./api.js";
import { button, h, seconds } from "./dom.js";
import { S, busy, load, refused, takeLease, unlit } from "./state.js";

const notices = document.getElementById("notices");

/** Show a sentence for a while. */
export function notice(text, kind = "") {
  const made = h(`p.notice${kind ? "." + kind : ""}`, text);
  notices.append(made);
  setTimeout(() => made.remove(), kind === "bad" ? 15_000 : 6000);
}

const CANCELLED = new Error("cancelled");

/** Run `work`; show a notice if it fails. */
export async function attempt(work) {
  try {
    return await work();
  } catch (error) {
    if (error === CANCELLED) return undefined;
    notice(error.status === 401 ? "Log in again." : error.message, "bad");
    return undefined;
  }
}

export async function abort() {
  if (!busy()) return notice("No capture is running.");
  const { id } = S.capture;
  await attempt(() => request(`POST ${captureAt(id)}/abort`));
  return load.capture(id).catch(() => {});
}

export function timeLeft(c) {
  if (c.state === "aborting") return "ends after this step";
  if (c.state === "finishing") return "writes the last frames";
  if (c.state === "paused") return "lights off";
  const s = c.progress?.seconds_left;
  return s === null || s === undefined ? "time left: unknown" : `${seconds(s)} left`;
}

/** The name that other operators see. Raises `CANCELLED` if the person enters none. */
export async function operatorName() {
  const known = (localStorage.getItem("name") ?? S.who?.name ?? "").trim();
  if (known) return known;
  const name = await promptName("Your name, as other operators see it", "Steer");
  localStorage.setItem("name", name);
  return name;
}

/** A name from a dialog. Raises `CANCELLED` if the person closes it. */
export async function promptName(label, go) {
  const field = h("input", { name: "holder", required: true, maxlength: 100, pattern: ".*\\S.*", title: "a name", autocomplete: "name" });
  await confirmed(label, [h("label", label, field)], go);
  return field.value.trim();
}

/** Resolves when the person confirms `content` by the button `go`; raises `CANCELLED` otherwise. Not modal, unlike the
 * browser's own dialogs: Blackout stays within reach. */
export function confirmed(label, content, go) {
  return new Promise((done, cancel) => {
    const box = h("dialog", { "aria-label": label, onkeydown: (event) => { if (event.key === "Escape") box.close(); } }, h("form", { onsubmit: (event) => {
      event.preventDefault();
      done();
      box.close();
    } }, content, h(".line", h("button.go", go), button("Cancel", () => box.close()))));
    box.addEventListener("close", () => { box.remove(); cancel(CANCELLED); }); // no effect after `done`
    for (const other of document.querySelectorAll("dialog")) other.close();
    document.body.append(box);
    box.show();
  });
}

/** A button for an action that needs the lease: disabled, with the reason as its title, while this page may not steer.
 * `lights`: the action lights lamps. */
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

/** Take the lease, unless this page holds it. */
export async function underLease() {
  await takeLease(await operatorName());
}

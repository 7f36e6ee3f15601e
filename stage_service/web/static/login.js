// The login form. Blackout stays available around it.

import { BASE, get, request } from "./api.js";
import { keepRight, rightHeader } from "./blackout.js";
import { h, setContent } from "./dom.js";

/** Show the form in `view`. The page reloads after a login in any tab of this browser. */
export function loginForm(view) {
  const token = h("input", { type: "password", name: "token", required: true, autocomplete: "current-password", maxlength: 200 });
  const wrong = h("p.bad", { role: "alert" });
  view.setAttribute("aria-label", "log in");
  view.replaceChildren(h("form.login", { onsubmit: async (event) => {
    event.preventDefault();
    try {
      keepRight(await request("POST /login", { token: token.value.trim() }, { headers: { ...rightHeader(), "Hairstage-Path": BASE } }));
      location.reload();
    } catch (error) {
      setContent(wrong, error.message);
    }
  } }, h("h1", "hairstage"), h("label", "Your token", token), h("p.quiet", h("code", "hairstage token show"), " on the service's machine prints it."), wrong, h("button.go", "Log in")));
  token.focus();
  addEventListener("focus", () => get("/login").then(() => location.reload(), () => {}));
}

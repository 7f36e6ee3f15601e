// The form that takes a token; the page around it keeps its Blackout.

import { ask, get } from "./ask.js";
import { keepRight, rightHeader } from "./blackout.js";
import { h, say } from "./dom.js";

/** Put the form into `view`. The page is loaded anew once it, or another of this browser, has logged in. */
export function loginForm(view) {
  const token = h("input", { type: "password", name: "token", required: true, autocomplete: "current-password", maxlength: 200 });
  const wrong = h("p.bad", { role: "alert" });
  view.setAttribute("aria-label", "log in");
  view.replaceChildren(h("form.login", { onsubmit: async (event) => {
    event.preventDefault();
    try {
      keepRight(await ask("POST /login", { token: token.value.trim() }, { headers: rightHeader() }));
      location.reload();
    } catch (error) {
      say(wrong, error.message);
    }
  } }, h("h1", "hairstage"), h("label", "Your token", token), h("p.quiet", h("code", "hairstage token show"), " prints it, on the service's machine."), wrong, h("button.go", "Log in")));
  token.focus();
  addEventListener("focus", () => get("/login").then(() => location.reload(), () => {}));
}

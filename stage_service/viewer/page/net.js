// Requests to the service that the page came from. A service knows the browser by the cookie of its
// login; 'hairstage view' by the key in the address, which opens this one model while it runs.

const fragment = new URLSearchParams(location.hash.slice(1));
export const model = fragment.get("model") ?? new URLSearchParams(location.search).get("model");
const KEY = "hairstage-view";
if (fragment.get("token")) {
  sessionStorage.setItem(KEY, fragment.get("token"));
  // out of the address: it is not to be copied along with it
  history.replaceState(null, "", `${location.pathname}#model=${encodeURIComponent(model ?? "")}`);
}

export class Refused extends Error {}

export async function ask(path, options = {}) {
  const token = sessionStorage.getItem(KEY);
  const headers = { ...options.headers };
  if (token) headers.Authorization = `Bearer ${token}`;
  const answer = await fetch(path, { ...options, headers });
  if (answer.ok) return answer;
  let detail = `${answer.status} ${answer.statusText}`;
  try { detail = (await answer.json()).detail ?? detail; } catch { /* no problem document */ }
  if (answer.status === 401) throw new Refused(detail);
  throw new Error(detail);
}

export const login = (token) => ask("/login", {
  method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify({ token }) });
export const ofModel = (part) => `/view/models/${encodeURIComponent(model)}${part}`;
export const bytes = async (part, options) => (await ask(ofModel(part), options)).arrayBuffer();
export const json = async (path, options) => (await ask(path, options)).json();

// Requests to the service. A stage service authenticates the browser by its login cookie, 'hairstage
// view' by the key in the page's address, which opens one model while the command runs.

const fragment = new URLSearchParams(location.hash.slice(1));
export const model = fragment.get("model") ?? new URLSearchParams(location.search).get("model");
const KEY = "hairstage-view";
if (fragment.get("token")) {
  sessionStorage.setItem(KEY, fragment.get("token"));
  // removed from the address, so that a copied address has no key
  history.replaceState(null, "", `${location.pathname}#model=${encodeURIComponent(model ?? "")}`);
}

export class Refused extends Error {}

export async function request(path, options = {}) {
  const token = sessionStorage.getItem(KEY);
  const headers = { ...options.headers };
  if (token) headers.Authorization = `Bearer ${token}`;
  const response = await fetch(path, { ...options, headers });
  if (response.ok) return response;
  let detail = `${response.status} ${response.statusText}`;
  try { detail = (await response.json()).detail ?? detail; } catch { /* no problem document */ }
  if (response.status === 401) throw new Refused(detail);
  throw new Error(detail);
}

export const login = (token) => request("login", {
  method: "POST", headers: { "content-type": "application/json", "Hairstage-Path": new URL(".", location).pathname },
  body: JSON.stringify({ token }) });
export const ofModel = (part) => `view/models/${encodeURIComponent(model)}${part}`;
export const bytes = async (part, options) => (await request(ofModel(part), options)).arrayBuffer();
export const json = async (path, options) => (await request(path, options)).json();

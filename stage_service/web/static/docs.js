// The API on a page, from /openapi.json: each route, its fields, and a command line that calls it.

import { h, setContent } from "./dom.js";

const view = document.getElementById("view");
const at = location.href.replace(/\/docs.*/, "");

function schemaOf(schema, api) {
  if (!schema) return {};
  return schema.$ref ? api.components.schemas[schema.$ref.split("/").at(-1)] : schema;
}

/** A type in a word or two. */
function kind(s) {
  if (!s) return "";
  if (s.$ref) return s.$ref.split("/").at(-1);
  if (s.const !== undefined) return JSON.stringify(s.const);
  if (s.enum) return s.enum.map((x) => JSON.stringify(x)).join(" | ");
  if (s.anyOf) return s.anyOf.map(kind).join(" | ");
  if (s.type === "array") return `[${kind(s.items) || "…"}]`;
  return s.type ?? "any";
}

function fieldsOf(schema, api) {
  const made = schemaOf(schema, api);
  if (!made.properties) return h("p.quiet", kind(schema));
  const rows = Object.entries(made.properties).map(([name, s]) => h("tr", h("th", { scope: "row" }, h("code", name), made.required?.includes(name) ? " *" : ""), h("td", kind(s)), h("td", s.default === undefined || s.default === null ? "" : JSON.stringify(s.default))));
  return h("", made.description ? h("p.quiet", made.description) : "", h(".wide", h("table", h("thead", h("tr", h("th", "field"), h("th", "type"), h("th", "default"))), h("tbody", rows))));
}

function operation(method, path, op, api) {
  const body = op.requestBody?.content?.["application/json"]?.schema;
  const example = body && schemaOf(body, api).examples?.[0];
  const line = `curl ${method === "GET" ? "" : `-X ${method} `}${at}${path} -H "Authorization: Bearer $(hairstage token show)"${body ? ` \\\n     -H 'content-type: application/json' -d '${JSON.stringify(example ?? {})}'` : ""}`;
  const good = Object.entries(op.responses).find(([code]) => code.startsWith("2"));
  const response = good?.[1].content?.["application/json"]?.schema;
  return h("details", { id: op.operationId }, h("summary", h("code", h("b", method), ` ${path}`), h("span.quiet", ` ${op.description?.split(/\.\s/)[0] ?? op.summary ?? ""}`)),
    h("p", op.description),
    op.parameters?.length ? h("table", h("tbody", op.parameters.map((p) => h("tr", h("th", { scope: "row" }, h("code", p.name)), h("td", p.in), h("td", kind(p.schema)), h("td", p.description ?? ""))))) : "",
    body ? [h("h3", "request body"), fieldsOf(body, api)] : "",
    response ? [h("h3", `response ${good[0]}`), fieldsOf(response.type === "array" ? response.items : response, api)] : "",
    h("pre", { tabindex: "0" }, h("code", line)));
}

try {
  const api = await (await fetch("./openapi.json")).json();
  const groups = new Map();
  for (const [path, item] of Object.entries(api.paths)) {
    for (const [method, op] of Object.entries(item)) {
      const tag = op.tags?.[0] ?? "other";
      if (!groups.has(tag)) groups.set(tag, []);
      groups.get(tag).push(operation(method.toUpperCase(), path, op, api));
    }
  }
  setContent(view, h("h1", `${api.info.title} ${api.info.version}`), h("p", api.info.summary), h("p.quiet", "Every route except the open ones needs a token. Problem types are ", h("a", { href: "./docs/errors.md" }, "documented"), ". The schema: ", h("a", { href: "./openapi.json" }, "openapi.json"), ". The ", h("a", { href: "./" }, "console"), "."),
    ...[...groups].map(([tag, rows]) => h("section.api", { "aria-label": tag }, h("h2", tag), rows)));
} catch (error) {
  setContent(view, h("p.bad", `/openapi.json: ${error.message}`));
}

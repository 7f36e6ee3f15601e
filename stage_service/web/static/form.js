// A form from a JSON schema of pydantic; empty fields are omitted.

import { h, numberIn, words } from "./dom.js";

const plain = (value) => (value === undefined || value === null ? "" : Array.isArray(value) ? value.join(", ") : String(value));

/** `{element, value(), fill(value)}` of an object's schema; `hints[path]` is the placeholder of an empty field. */
export function formOf(schema, defs, { hints = {}, skip = [], onchange }) {
  const fields = [];
  const groups = [h(".fields")];
  build(schema, []);

  function build(object, path) {
    for (const [name, given] of Object.entries(object.properties)) {
      const here = [...path, name];
      if (skip.includes(here.join("."))) continue;
      const kind = resolved(given);
      if ("const" in given) continue;  // nothing to choose
      if (kind.type === "object" && kind.properties) {
        const own = h(".fields");
        groups.push(h("fieldset", h("legend", words(name)), own));
        const before = groups[0];
        groups[0] = own;
        build(kind, here);
        groups[0] = before;
      } else groups[0].append(field(here, kind));
    }
  }

  function resolved(given) {
    if (given.$ref) return { ...defs[given.$ref.split("/").at(-1)], default: given.default };
    if (!given.anyOf) return given;
    const kinds = given.anyOf.filter((x) => x.type !== "null").map(resolved);
    const nullable = kinds.length < given.anyOf.length;
    return { ...kinds[0], kinds, nullable, default: given.default };
  }

  function field(path, kind) {
    const id = path.join(".");
    const label = words(path.at(-1));
    const hint = hints[id];
    const made = control(id, kind, hint);
    fields.push({ path, ...made });
    made.input.name = id;
    made.input.addEventListener("input", onchange);
    return kind.type === "boolean" ? h("label.check", made.input, h("span", label)) : h("label", h("span", label), made.input);
  }

  function control(id, kind, hint) {
    if (kind.type === "boolean") {
      const input = h("input", { type: "checkbox", checked: kind.default ?? false });
      return { input, read: () => (input.checked === kind.default ? undefined : input.checked), write: (v) => { input.checked = v ?? kind.default; } };
    }
    if (kind.enum) {
      const first = kind.default ?? (kind.nullable ? "" : kind.enum[0]);
      const input = h("select", (kind.nullable ? ["", ...kind.enum] : kind.enum).map((x) => h("option", { value: x }, x || "–")));
      input.value = first;
      return { input, read: () => (input.value === first ? undefined : input.value), write: (v) => { input.value = v ?? first; } };
    }
    if (kind.type === "number" || kind.type === "integer") {
      const input = h("input", { type: "number", step: kind.type === "integer" ? 1 : "any", min: kind.minimum ?? kind.exclusiveMinimum, max: kind.maximum, placeholder: hint ?? (kind.default ?? "") });
      return { input, read: () => numberIn(input), write: (v) => { input.value = v ?? ""; } };
    }
    // Names, numbers with commas, or a text: the API validates them.
    const many = (kind.kinds ?? [kind]).find((x) => x.type === "array");
    const items = many && (many.items ?? many.prefixItems?.[0]);
    const input = h("input", { type: "text", placeholder: hint ?? plain(kind.default), spellcheck: false, autocomplete: "off" });
    return {
      input,
      read() {
        const text = input.value.trim();
        if (text === "") return undefined;
        if (!many || text === "all") return text;
        if (text === "none") return [];
        const parts = text.split(/[\s,]+/).filter(Boolean);
        return ["number", "integer"].includes(items?.type) ? parts.map(Number) : parts;
      },
      write(v) { input.value = v === undefined ? "" : Array.isArray(v) ? v.join(", ") || "none" : v; },
    };
  }

  return {
    element: h("", h("fieldset", h("legend", "capture"), groups[0]), groups.slice(1)),
    value() {
      const out = {};
      for (const { path, read } of fields) {
        const value = read();
        if (value === undefined) continue;
        let place = out;
        for (const name of path.slice(0, -1)) place = place[name] ??= {};
        place[path.at(-1)] = value;
      }
      return out;
    },
    fill(value) {
      for (const { path, write } of fields) write(path.reduce((x, name) => x?.[name], value));
    },
    set(id, value) {
      fields.find((x) => x.path.join(".") === id)?.write(value);
      onchange();
    },
    get: (id) => fields.find((x) => x.path.join(".") === id)?.read(),
  };
}

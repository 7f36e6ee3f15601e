// Elements, and formatting of numbers.

/** An element: `h("p.quiet", {title}, "text", child)`. Attributes that begin with "on" add event listeners. */
export function h(name, attributes, ...children) {
  if (attributes === undefined || attributes === null || attributes instanceof Node
      || typeof attributes !== "object" || Array.isArray(attributes)) {
    children.unshift(attributes);
    attributes = {};
  }
  const [tag, ...classes] = name.split(".");
  const made = document.createElement(tag || "div");
  if (classes.length) made.className = classes.join(" ");
  return put(attributed(made, attributes), children);
}

/** The same in SVG. */
export function svg(tag, attributes = {}, ...children) {
  return put(attributed(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes), children);
}

function attributed(made, attributes) {
  for (const [key, value] of Object.entries(attributes)) {
    if (value === undefined || value === null || value === false) continue;
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (["value", "checked", "disabled", "hidden", "open"].includes(key)) made[key] = value;
    else made.setAttribute(key, value === true ? "" : value);
  }
  return made;
}

function put(made, children) {
  for (const child of children.flat(9)) {
    if (child === undefined || child === null || child === false) continue;
    made.append(child instanceof Node ? child : String(child));
  }
  return made;
}

/** Replace the content of `parent`, unless it is the same text. */
export function setContent(parent, ...children) {
  const text = children.length === 1 && !(children[0] instanceof Node) ? String(children[0] ?? "") : null;
  if (text !== null && parent.childElementCount === 0 && parent.textContent === text) return;
  parent.replaceChildren();
  put(parent, children);
}

/** Rows by key: existing rows are updated in place, which keeps focus and scroll position. */
export function keyed(parent, items, key, make) {
  const before = parent._rows ?? new Map();
  const rows = new Map();
  for (const item of items) {
    const id = key(item);
    const row = before.get(id) ?? make(item);
    row.update?.(item);
    rows.set(id, row);
  }
  for (const [id, row] of before) if (!rows.has(id)) row.element.remove();
  let place = parent.firstElementChild;
  for (const row of rows.values()) {
    if (row.element === place) place = place.nextElementSibling;
    else parent.insertBefore(row.element, place);
  }
  parent._rows = rows;
}

export function button(text, onclick, more = {}) {
  const { kind = "", ...rest } = more;
  return h(`button${kind ? "." + kind : ""}`, { type: "button", onclick, ...rest }, text);
}

/** Rows of a definition list, from {name: value}. */
export const definitions = (rows) => Object.entries(rows).map(([name, value]) => h("div", h("dt", name), h("dd", value)));

export function seconds(s) {
  if (s === null || s === undefined) return "–";
  if (s < 0.0995) return `${(1000 * s).toPrecision(2)} ms`;
  if (s < 9.95) return `${s.toFixed(1)} s`;
  if (s < 99.5) return `${Math.round(s)} s`;
  if (s < 5970) return `${Math.floor(Math.round(s) / 60)} min ${String(Math.round(s) % 60).padStart(2, "0")} s`;
  return `${Math.floor(s / 3600)} h ${String(Math.round((s % 3600) / 60)).padStart(2, "0")} min`;
}

export function bytes(n) {
  if (n === null || n === undefined) return "–";
  for (const [size, unit] of [[1e12, "TB"], [1e9, "GB"], [1e6, "MB"], [1e3, "kB"]]) {
    if (n >= size) return `${number(n / size)} ${unit}`;
  }
  return `${n} B`;
}

/** The value of a number field: undefined if empty; a text, which the API refuses, if invalid: browsers report "1e" and
 * "0,5" as empty. */
export function numberIn(input) {
  if (input.validity.badInput) return "no number";
  return input.value === "" ? undefined : Number(input.value);
}

/** Three significant digits, thousands separated. */
export function number(n) {
  if (n === null || n === undefined || !Number.isFinite(n)) return "–";
  if (Number.isInteger(n)) return n.toLocaleString("en");
  if (n !== 0 && (Math.abs(n) < 1e-3 || Math.abs(n) >= 1e7)) return n.toExponential(2);
  return Number(n.toPrecision(3)).toLocaleString("en", { maximumFractionDigits: 6 });
}

export const percent = (share) => `${(100 * share).toFixed(share < 0.1 && share > 0 ? 1 : 0)} %`;

/** A local time; with its date unless that is today. */
export function clock(iso) {
  if (!iso) return "–";
  const at = new Date(iso);
  const time = at.toLocaleTimeString("en-GB");
  return at.toDateString() === new Date().toDateString() ? time : `${at.toLocaleDateString("sv")} ${time}`;
}

/** A message of the service with its times (ISO 8601, or date and time in UTC) in local time. */
export const local = (text) => (text ?? "")
  .replace(/\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?(Z|[+-]\d\d:\d\d)/g, (iso) => clock(iso))
  .replace(/(\d{4}-\d\d-\d\d) (\d\d:\d\d:\d\d) UTC/g, (_, day, time) => clock(`${day}T${time}Z`));

/** An API name as a label: "square_mm" becomes "square, mm". */
export const words = (name) => name.replace(/_(mm|px|deg|s|hz)$/, (_, unit) => `, ${unit === "hz" ? "Hz" : unit}`).replaceAll("_", " ");

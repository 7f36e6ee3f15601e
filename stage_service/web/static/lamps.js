// Texts for the state of the lamps. They claim no more than the read-back shows.

import { S, silence } from "./state.js";

const UNKNOWN = {
  bar: "unknown", tone: "bad", headline: "Not known to be dark", lit: "not known what is lit", fact: "unknown, unsafe",
};
const WORDS = {
  latched: { ...UNKNOWN, bar: "unsafe", headline: "UNSAFE" },
  dark: { bar: "dark", tone: "calm", headline: "Dark, verified", lit: "nothing is lit", fact: "dark, verified" },
  doubted: { bar: "reported dark", tone: "warn", headline: "Reported dark", lit: "the light bank reports no lamp lit", fact: "reported dark" },
  confirmed: {
    bar: "reported by a person", tone: "warn", headline: "Reported dark by a person", lit: "no lamp is lit, as a person at the stage reports", fact: "reported dark by a person",
  },
  accepted: {
    bar: "off was sent", tone: "warn", headline: "Off was sent, not read back", lit: "off was sent; the light bank cannot report what is lit",
    fact: "off was sent, not read back",
  },
  use: { ...UNKNOWN, fact: "in use" },
  unknown: UNKNOWN,
};

/** Whether a message of the service reports that the light bank's read-back contradicted a command. */
export const contradicts = (text) => Boolean(text?.includes("reported lamps as off that were commanded on"));
const doubted = (health) => contradicts(health?.lamps_detail) || contradicts(S.capture?.error);

/** State of the lamps by `GET /health`: dark (read back), doubted (read back by a bank whose read-back contradicted a
 * command before), confirmed (by a person), accepted (off was sent to a bank that cannot read back), use (by a capture),
 * latched (a blackout failed), unknown. */
export function lampState(health) {
  if (health?.latch) return "latched";
  if (health?.lamps_accepted) return "accepted";
  const state = { dark: "dark", "said to be dark": "confirmed", "in use": "use" }[health?.lamps] ?? "unknown";
  return state === "dark" && doubted(health) ? "doubted" : state;
}

/** Texts `bar`, `headline`, `lit` and `fact` by their place on the page; `tone` is a CSS class; `detail` is the evidence;
 * `alarm` (heading, text) is shown when no latch is set. */
export function lampWords(health) {
  const state = lampState(health);
  const detail = (health?.lamps_detail ?? "").replace(/^unknown, unsafe: /, "").replace(/^./, (first) => first.toUpperCase()).replace(/([^.])$/, "$1.");
  const known = { ...WORDS[state], state, detail, alarm: alarm(state, health && detail) };
  const silent = silence();
  if (!silent) return known;
  return {
    ...known, bar: "no response", tone: "bad", headline: `No response since ${silent.clock}`, lit: "not known what is lit",
    fact: `not known; at ${silent.clock}: ${known.fact}`,
  };
}

function alarm(state, detail) {
  if (state === "accepted") return ["Off was sent, but the light bank cannot report whether the lamps are off. ", `${detail} A blackout cannot verify it: inspect the stage before anybody enters.`];
  if (state === "doubted") return ["Reported dark by a light bank whose read-back contradicted a command. ", `${contradicts(S.capture?.error) ? `In capture ${S.capture.id} it` : "It"} reported lamps as off that were commanded on. Inspect the stage before anybody enters.`];
  if (state === "unknown" && detail) return ["It is not known whether the lamps are off. ", `${detail} A blackout (F9) switches them off and reads back each device that supports it.`];
  return null;
}

/** Why the state of a responding device of this `kind` is in doubt; null: it is not. */
export function doubt(health, kind) {
  const state = lampState(health);
  if (state === "latched" || state === "unknown") return health ? "but unsafe" : null;
  if (state === "doubted" && kind === "lights") return "but its read-back contradicted a command";
  return state === "accepted" && kind === "lights" ? "but cannot report whether its lamps are off" : null;
}

/** The lights that the latch message names: they may still be lit. */
export function suspects() {
  const named = new Set((S.health?.latch?.detail ?? "").match(/[\w.-]+/g));
  return new Set((S.rig?.lights ?? []).map((light) => light.name).filter((name) => named.has(name)));
}

// What is known of the lamps, in this console's words: none that claims more than was read back.

const UNKNOWN = {
  bar: "unknown", tone: "bad", headline: "Not known to be dark", lit: "nobody knows what is lit", fact: "unknown, unsafe",
};
const WORDS = {
  latched: { ...UNKNOWN, bar: "unsafe", headline: "UNSAFE" },
  dark: { bar: "dark", tone: "calm", headline: "Dark, verified", lit: "nothing is lit", fact: "dark, verified" },
  said: {
    bar: "said to be dark", tone: "warn", headline: "Said to be dark", lit: "nothing is lit, says who has looked", fact: "said to be dark",
  },
  accepted: {
    bar: "off was sent", tone: "warn", headline: "Off was sent, not read back", lit: "off was sent; the light bank cannot say what is lit",
    fact: "off was sent, not read back",
  },
  use: { ...UNKNOWN, fact: "in use" },
  unknown: UNKNOWN,
};

/** Which of these `GET /health` tells: dark (read back), said (somebody looked), accepted (sent to a bank that
 * cannot read back), use (a capture has them), latched (a blackout failed), unknown. */
export function lampState(health) {
  if (health?.latch) return "latched";
  if (health?.lamps_accepted) return "accepted";
  return { dark: "dark", "said to be dark": "said", "in use": "use" }[health?.lamps] ?? "unknown";
}

/** `bar`, `headline`, `lit` and `fact` are named for their places, `tone` is a class. `detail` is how it is
 * known; `alarm` is what has to be seen, in two parts, where no latch says it. */
export function lampWords(health) {
  const state = lampState(health);
  const detail = (health?.lamps_detail ?? "").replace(/^unknown, unsafe: /, "").replace(/([^.])$/, "$1.");
  return { ...WORDS[state], state, detail, alarm: alarm(state, health && detail) };
}

function alarm(state, detail) {
  if (state === "accepted") return ["Off was sent, and nothing says that the lamps are off. ", `${detail} No blackout finds out: look before anybody goes in.`];
  if (state === "unknown" && detail) return ["Nobody knows whether the lamps are off. ", `${detail} A blackout (F9) sends off, and reads it back where that can be.`];
  return null;
}

/** What a device that can be left on, `kind`, is to be doubted for though it answers; null: nothing. */
export function doubt(health, kind) {
  const state = lampState(health);
  if (state === "latched" || state === "unknown") return health ? "but unsafe" : null;
  return state === "accepted" && kind === "lights" ? "but cannot say whether its lamps are off" : null;
}

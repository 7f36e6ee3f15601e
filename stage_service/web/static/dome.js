// The dome from above, equal areas: the zenith in the middle, the face looking down the page.

import { svg } from "./dom.js";

const place = ([x, y, z]) => {
  const far = Math.hypot(x, y, z) || 1;
  const flat = Math.hypot(x, y) || 1;
  const r = Math.sqrt(Math.max(0, 1 - z / far) / 2);
  return [(r * x) / flat, (-r * y) / flat];
};

/** A picture of `rig`; `onpick(name)` is called when a light is clicked.
 *
 * `show({lit, shot, missing, chosen, doubt, projector})`: the lit light ("all" for all); sets of names of lights that were
 * captured, lack frames, are selected, may be lit; the projector that is on. */
export function dome(rig, { onpick = null, label = "" } = {}) {
  const lights = new Map();
  const radius = Math.min(0.05, 0.62 / Math.sqrt(rig.lights.length));
  const spots = rig.lights.map((light) => {
    const [x, y] = place(light.position);
    const spot = svg("circle", { class: "light", cx: x.toFixed(4), cy: y.toFixed(4), r: radius.toFixed(4) },
      svg("title", {}, light.name));
    if (onpick) {
      spot.classList.add("pick");
      spot.addEventListener("click", () => onpick(light.name));
    }
    lights.set(light.name, spot);
    return spot;
  });
  const projectors = new Map();
  const devices = [
    ...rig.cameras.map((c) => mark(c, "camera", "M-.5-.36H.16V.36H-.5ZM.16-.14.5-.32V.32L.16.14Z")),
    ...rig.projectors.map((p) => {
      const made = mark(p, "projector", "M-.42-.42H.42V.42H-.42Z");
      projectors.set(p.name, made);
      return made;
    }),
  ];
  const element = svg("svg", { class: "dome", viewBox: "-1.06 -1.06 2.12 2.12", role: "img", "aria-label": label },
    svg("circle", { class: "rim", r: 1 }),
    svg("circle", { class: "equator", r: Math.SQRT1_2 }),
    svg("path", { class: "head", d: "M-.05.025C-.05-.075.05-.075.05.025L.02.06 0 .085-.02.06Z" }),
    ...spots, ...devices);
  let before = [];
  // The one that is lit is another circle over all of them, which moves: nothing else is drawn anew.
  const named = svg("title");
  const over = svg("circle", { class: "light lit", r: radius.toFixed(4) }, named);

  function mark(device, kind, path) {
    const [x, y] = place(device.position);
    const turn = (Math.atan2(-y, -x) * 180) / Math.PI;
    return svg("path", { class: kind, d: path, transform: `translate(${x.toFixed(4)} ${y.toFixed(4)}) rotate(${turn.toFixed(1)}) scale(${(2.1 * radius).toFixed(4)})` },
      svg("title", {}, `${kind} ${device.name}`));
  }

  return {
    element,
    show({ lit = null, shot = null, missing = null, chosen = null, doubt = null, projector = null }) {
      const now = [lit, ...[shot, missing, chosen, doubt].map((set) => set && [...set].join()), projector];
      const same = now.map((x, i) => x === before[i]);
      before = now;
      if (!same[0]) {
        element.classList.toggle("all", lit === "all");
        const spot = lights.get(lit);
        if (spot) {
          for (const at of ["cx", "cy"]) over.setAttribute(at, spot.getAttribute(at));
          named.textContent = lit;
          if (!over.parentNode) element.append(over);
        } else over.remove();
      }
      if (!same[5]) for (const [name, made] of projectors) made.classList.toggle("on", projector === "all" || projector === name);
      if (same[1] && same[2] && same[3] && same[4]) return;
      for (const [name, spot] of lights) {
        spot.classList.toggle("shot", shot?.has(name) ?? false);
        spot.classList.toggle("lacks", missing?.has(name) ?? false);
        spot.classList.toggle("chosen", chosen?.has(name) ?? false);
        spot.classList.toggle("doubt", doubt?.has(name) ?? false);
      }
    },
  };
}

// The panel beside the picture: what is shown, and how.

import * as net from "./net.js";

export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

export function labelled(text, control) {
  return element("label", {}, element("span", { textContent: text }), control);
}

export function choice(options, value, changed) {
  const made = element("select");
  for (const [name, text] of options) made.append(element("option", { value: name, textContent: text }));
  made.value = value;
  made.addEventListener("change", () => changed(made.value));
  return made;
}

export function slider(low, high, step, value, changed) {
  const made = element("input", { type: "range", min: low, max: high, step, value });
  made.addEventListener("input", () => changed(Number(made.value)));
  return made;
}

const count = (n) => n.toLocaleString("en");

export class Controls {
  constructor(panel, viewer) {
    Object.assign(this, { panel, viewer });
    const { about } = viewer, { model } = about.strands;
    panel.replaceChildren(
      element("h1", { textContent: about.name }),
      element("p", { textContent: `${count(model.count)} strands of ${model.points} points, half ` +
        `of the model's points within ${model.deviation_mm[0].toFixed(2)} mm of them, 95 % within ` +
        `${model.deviation_mm[1].toFixed(2)}, all within ${model.deviation_mm[2].toFixed(2)}` }),
      ...this.strands());
  }

  strands() {
    const { viewer } = this, { state } = viewer.picture, { about } = viewer;
    const colours = [["direction", "direction, root to tip"], ["root", "place of the root"],
      ["length", "length"]];
    if (about.confidence) colours.splice(1, 0, ["confidence", "distance to a measured point"]);
    this.legend = element("p");
    const out = [element("h2", { textContent: "Strands" }),
      labelled("colour", this.colour = choice(colours, state.mode, (v) => this.setMode(v)))];
    if (about.strands.truth) {
      const shows = [["model", "the model"], ["truth", "the truth"], ["beside", "beside each other"],
        ["over", "one over the other"]];
      out.push(labelled("show", choice(shows, "model", (v) => { state.show = v; this.explain(); })));
    }
    out.push(this.legend, ...this.slices());
    if (about.head) {
      const head = element("input", { type: "checkbox", checked: true });
      head.addEventListener("change", () => { state.head = head.checked; viewer.draw(); });
      out.push(labelled("head", head));
    }
    this.explain();
    return out;
  }

  slices() {
    const { viewer } = this, { state } = viewer.picture, { low, high } = viewer.about.strands.model;
    const axes = [["", "none"], ["0", "from the side"], ["1", "from the front"], ["2", "from above"]];
    let axis = "", share = 0.5;
    const put = () => {
      if (axis === "") state.slice = null;
      else {
        const i = Number(axis), n = [0, 0, 0], sign = i === 1 ? -1 : 1;
        n[i] = sign;
        state.slice = [...n, sign * (low[i] + (high[i] - low[i]) * share)];
      }
      where.disabled = axis === "";
      viewer.draw();
    };
    const where = slider(0, 1, 0.005, share, (v) => { share = v; put(); });
    where.setAttribute("aria-label", "where the slice is");
    const which = choice(axes, "", (v) => { axis = v; put(); });
    put();
    return [labelled("slice", which), labelled("at", where)];
  }

  async setMode(mode) {
    const { viewer } = this, { picture } = viewer;
    if (mode === "confidence" && !picture.sets.model.level) {
      viewer.status("measuring how far each strand is from what was measured");
      try {
        picture.sets.model.level = picture.sets.model.perPoint(await net.bytes("/confidence"));
        viewer.status("");
      } catch (error) { return viewer.status(error.message); }
    }
    picture.state.mode = mode;
    this.explain();
  }

  explain() {
    const { viewer } = this, { state } = viewer.picture, { about } = viewer;
    const longest = (1e3 * about.strands.model.longest).toFixed(0);
    this.legend.textContent = state.show === "over" ? "orange: the model; blue: the truth"
      : {
        direction: "red, green, blue: towards +x (the subject's left), back, up",
        confidence: `yellow: measured there; dark: ${about.confidence_mm} mm and more from any ` +
          "measured point, grown by a rule",
        root: "hue: where on the scalp the strand is rooted",
        length: `dark: short; yellow: ${longest} mm`, lit: "" }[state.mode];
    viewer.draw();
  }
}

// The control panel.

import * as net from "./net.js";
import { Relight } from "./relight.js";
import { Pinhole, add, scale } from "./space.js";

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
    const [half, most, all] = model.deviation_mm.map((mm) => mm.toFixed(2));
    panel.replaceChildren(
      element("h1", { textContent: about.name }),
      element("p", { textContent: `${count(model.count)} strands of ${model.points} points. Distance of ` +
        `the rendered curves from them: median ${half} mm, 95 % ${most} mm, maximum ${all} mm.` }),
      ...this.strands(), ...this.cameras());
    this.light().catch((error) => viewer.status(error.message));
  }

  // Light is loaded after the strands are drawn.
  async light() {
    const { viewer } = this;
    viewer.relight = this.relight = await Relight.begin(viewer);
    if (this.relight.data.material) this.colour.append(
      element("option", { value: "lit", textContent: "lit" }));
    this.panel.append(...this.relight.controls());
    const { camera } = viewer.picture.state;  // selected meanwhile
    if (camera) await this.look(camera.name);
  }

  cameras() {
    const { viewer } = this, { about, picture } = viewer, { state } = picture;
    if (!about.cameras.length) return [];
    const size = 0.12, lines = [];
    const plain = [0.45, 0.48, 0.55];
    this.frusta = about.cameras.map((c) => {
      const p = new Pinhole(c), [fx, fy] = [c.K[0][0], c.K[1][1]];
      const corner = (u, v) => {
        const local = [(u - c.K[0][2]) / fx, (v - c.K[1][2]) / fy, 1].map((x) => x * size);
        return add(p.eye, [0, 1, 2].map((i) => local.reduce((s, x, k) => s + x * c.R[k][i], 0)));
      };
      const four = [corner(0, 0), corner(c.width, 0), corner(c.width, c.height), corner(0, c.height)];
      four.forEach((a, i) => {
        lines.push(...a, ...plain, ...four[(i + 1) % 4], ...plain, ...p.eye, ...plain, ...a, ...plain);
      });
      return { name: c.name, middle: scale(four.reduce(add), 0.25) };
    });
    picture.setWires(lines);
    const wires = element("input", { type: "checkbox" });
    wires.addEventListener("change", () => {
      state.wires = wires.checked;
      viewer.orbit.zoom(wires.checked ? 6 : 1 / 6);
      viewer.draw();
    });
    this.through = choice([["", "none"], ...about.cameras.map((c) => [c.name, c.name])],
      "", (name) => this.look(name));
    this.wipe = slider(0, 1, 0.005, 0.5, (v) => this.wiped(v));
    this.see = slider(0, 1, 0.02, 1, (v) => {
      state.opacity = v;
      this.wiped(Number(this.wipe.value));
      viewer.draw();
    });
    this.overlay = [labelled("strands", this.see), labelled("wipe", this.wipe),
      element("p", { textContent: "Left of the wipe: captured frames; right: the model." })];
    this.overlay.forEach((x) => { x.hidden = true; });
    viewer.leave = () => this.look("");
    viewer.click = (e) => this.pick(e);
    return [element("h2", { textContent: "Cameras" }), labelled("show them", wires),
      labelled("through", this.through), ...this.overlay];
  }

  // A click near a camera's frustum selects its view.
  pick(event) {
    const { viewer } = this, { state } = viewer.picture, { canvas } = viewer;
    if (!state.wires || state.camera) return;
    const { clientWidth: w, clientHeight: h } = canvas, view = viewer.view(w, h);
    const box = canvas.getBoundingClientRect();
    let best = [28, null];
    for (const { name, middle } of this.frusta) {
      const local = view.R.map((row, i) => row.reduce((s, x, k) => s + x * middle[k], view.t[i]));
      if (local[2] <= 0) continue;
      const u = view.K[0][0] * local[0] / local[2] + view.K[0][2];
      const v = view.K[1][1] * local[1] / local[2] + view.K[1][2];
      const off = Math.hypot(u - event.clientX + box.left, v - event.clientY + box.top);
      if (off < best[0]) best = [off, name];
    }
    if (best[1]) this.look(best[1]);
  }

  async look(name) {
    const { viewer, relight } = this, { state } = viewer.picture;
    const shown = document.getElementById("sum");
    state.camera = viewer.about.cameras.find((c) => c.name === name) ?? null;
    this.through.value = name;
    const captured = Boolean(name) && relight?.data.captured;
    this.overlay.forEach((x) => { x.hidden = !captured; });
    shown.hidden = !captured;
    if (!captured) {
      state.opacity = 1;
      this.see.value = 1;
      viewer.canvas.style.clipPath = "";
      return viewer.draw();
    }
    this.wiped(Number(this.wipe.value));
    viewer.draw();
    if (!Object.keys(relight.weights).length)
      relight.weights = Object.fromEntries(relight.directions.map((_, i) => [i, [1, 1, 1].map(
        (x) => x / Math.sqrt(relight.directions.length))]));
    await relight.set(relight.weights);
  }

  // Captured frames are shown left of `share` of the picture, the model right of it.
  wiped(share) {
    const { viewer } = this, { state } = viewer.picture, shown = document.getElementById("sum");
    const cut = `${(100 * share).toFixed(2)}%`;
    const over = state.opacity < 1;  // transparent strands cover the whole photograph
    shown.style.clipPath = over ? "" : `inset(0 calc(100% - ${cut}) 0 0)`;
    viewer.canvas.style.clipPath = state.camera && !over ? `inset(0 0 0 ${cut})` : "";
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
      viewer.status("computing distances to measured points");
      try {
        picture.sets.model.level = picture.sets.model.perPoint(await net.bytes("/confidence"));
        viewer.status("");
      } catch (error) { return viewer.status(error.message); }
    }
    if (mode === "lit" && !picture.lighting) {
      try { await this.relight.material(); } catch (error) { return viewer.status(error.message); }
    }
    picture.state.mode = mode;
    this.explain();
    if (mode === "lit") {
      try {
        if (!Object.keys(this.relight.weights).length) this.relight.towards([-0.6, -0.7, 0.4]);
        else await this.relight.set(this.relight.weights);
      } catch (error) { viewer.status(error.message); }
    }
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
        length: `dark: short; yellow: ${longest} mm`, lit: "the fitted material, see below" }[state.mode];
    viewer.draw();
  }
}

// Relighting by the dome or an environment map: of captured frames (summed by the server) and of the
// fitted model (in the shader).

import { element, labelled, slider } from "./controls.js";
import { texture } from "./gl.js";
import * as net from "./net.js";
import { dot, unit } from "./space.js";

const NEAREST = 3;
const MOST_CACHED = 24;  // lights whose visibility is cached; more than are shaded at once
const TRACED_PIXELS = 50000;  // resolution of traced indirect light

// Mean radiance of pixels [radiance × weight, weight].
function meanOf(pixels) {
  const sum = [0, 0, 0, 1e-9];
  for (let i = 0; i < pixels.length; i++) sum[i % 4] += pixels[i];
  return sum.slice(0, 3).map((x) => x / sum[3]);
}

export class Relight {
  static async begin(viewer) {
    return new Relight(viewer, await net.json(net.ofModel("/lighting")));
  }

  constructor(viewer, data) {
    Object.assign(this, { viewer, data, weights: {}, painting: false, lights: [], cache: new Map() });
    this.directions = data.lights.map((l) => unit(l.position));
    const { state } = viewer.picture;
    this.base = data.exposure;
    state.exposure = this.base;
  }

  // Load the material, once.
  async material() {
    const { gl, picture } = this.viewer, { material } = this.data;
    const values = new Float32Array(await net.bytes("/table"));
    const [wide, high] = [material.turns, 4 * material.cosines];
    this.table = texture(gl, gl.TEXTURE_2D, gl.LINEAR, () => {
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, wide, high);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, wide, high, gl.RGBA, gl.FLOAT, values);
    });
    this.nothing = texture(gl, gl.TEXTURE_2D, gl.NEAREST,
      () => gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, 1, 1));
    picture.setLighting(this);
  }

  // Turns until every light of each cluster has been drawn.
  turns() { return Math.max(1, ...this.lights.map((l) => l.turns.length)); }

  // The light that represents cluster `only` in this turn.
  inTurn(only, turn) { const { turns } = this.lights[only]; return turns[turn % turns.length]; }

  // Indirect light in the view of `camera`, traced by the server once per view and light when the view
  // is at rest.
  inView(camera) {
    const key = JSON.stringify([this.weights, camera]);
    if (key === this.rest?.key) return this.rest.done;
    for (const old of Object.values(this.rest?.textures ?? {})) this.viewer.gl.deleteTexture(old.texture);
    const rest = this.rest = { key };
    rest.done = this.traceView(rest, camera).catch((error) => this.viewer.status(error.message));
    return rest.done;
  }

  async traceView(rest, camera) {
    const { gl, picture } = this.viewer, { width, height, K, R, t } = camera.resized(TRACED_PIXELS);
    const values = new Float32Array(
      await net.bytes("/indirect/view", this.body({ view: { width, height, K, R, t } })));
    if (rest !== this.rest) return;
    const half = values.length / 2;
    const [uOfHair, uOfHead] = [0, half].map((first) => texture(gl, gl.TEXTURE_2D, gl.LINEAR, () => {
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, width, height);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, height, gl.RGBA, gl.FLOAT,
        values.subarray(first, first + half));
    }));
    rest.textures = { uOfHair, uOfHead };
    this.mean = [0, half].map((first) => meanOf(values.subarray(first, first + half)));
    picture.again();
  }

  // Uniforms of all lights, or of one, scaled to the power of all.
  uniforms(only) {
    const { material } = this.data, { model } = this.viewer.picture.sets;
    const used = only ? [only] : this.lights;
    const times = this.lights.length / Math.max(used.length, 1);
    const at = new Float32Array(24), power = new Float32Array(24);
    used.forEach((l, i) => {
      at.set(l.position, 3 * i);
      power.set(l.intensity.map((x) => times * x), 3 * i);
    });
    return {
      uLights: this.visibility ? used.length : 0, uLightAt: at, uLightPower: power,
      uVisible0: this.visibility?.[0] ?? model.none, uVisible1: this.visibility?.[1] ?? model.none,
      uTable: this.table, uVariance: material.variances, uTilt: material.tilt,
      uEta: material.eta, uLogistic: material.logistic_scale, uAbsorption: material.absorption,
      uGrid: [material.cosines, material.turns], uSkin: material.skin,
      uHairIndirect: this.lights.length ? this.mean[0] : [0, 0, 0],
      uHeadIndirect: this.lights.length ? this.mean[1] : [0, 0, 0], uAmbient: this.ambient,
      ...(this.rest?.textures ?? { uOfHair: this.nothing, uOfHead: this.nothing }),
    };
  }

  ambient = 1;
  mean = [[0, 0, 0], [0, 0, 0]];  // over the last traced view: hair, head; used in motion

  // Light from a direction: the nearest lights of the dome.
  towards(way, colour = [1, 1, 1]) {
    const direction = unit(way);
    const near = this.directions.map((d, i) => [Math.acos(Math.min(1, dot(d, direction))), i])
      .sort((a, b) => a[0] - b[0]).slice(0, NEAREST);
    const all = near.map(([angle]) => 1 / Math.max(angle, 1e-4));
    const sum = all.reduce((a, b) => a + b, 0);
    const brightest = near[0][0] < 0.01 ? [1, 0, 0] : all.map((w) => w / sum);
    const weights = this.painting ? { ...this.weights } : {};
    near.forEach(([, i], k) => {
      if (brightest[k] > 0) weights[i] = colour.map((c, j) =>
        (this.painting ? weights[i]?.[j] ?? 0 : 0) + brightest[k] * c);
    });
    return this.set(weights);
  }

  async set(weights) {
    this.weights = weights;
    this.paintDome?.();
    if (this.applying) { this.pending = true; return; }  // one at a time, then the latest
    this.applying = true;
    do {
      this.pending = false;
      try { await this.apply(); } catch (error) { this.viewer.status(error.message); }
    } while (this.pending);
    this.applying = false;
  }

  async apply() {
    const { viewer } = this, { state } = viewer.picture, body = this.body();
    const through = state.camera?.name;
    const jobs = [];
    if (through && this.data.captured) jobs.push(this.showSum(through, body));
    if (state.mode === "lit" && this.data.material) jobs.push(this.shade(body));
    await Promise.all(jobs);
    viewer.draw();
  }

  body(more = {}) {
    return { method: "POST", headers: { "content-type": "application/json" },
      body: JSON.stringify({ weights: this.weights, exposure: this.viewer.picture.state.exposure,
        ...more }) };
  }

  async showSum(camera, body) {
    this.viewer.status("adding up captured frames");
    const response = await net.request(net.ofModel(`/sums/${encodeURIComponent(camera)}.png`), body);
    const shown = document.getElementById("sum");
    if (shown.src) URL.revokeObjectURL(shown.src);
    shown.src = URL.createObjectURL(await response.blob());
    await shown.decode();
    const missing = this.data.missing[camera];
    this.viewer.status(
      missing ? `${missing} frames of ${camera} are missing: those of the nearest lights are used` : "");
  }

  async shade(body) {
    const { viewer } = this, { picture, gl } = viewer, hair = picture.sets.model;
    const lights = await net.json(net.ofModel("/few"), body);
    const points = hair.count * hair.points, vertices = picture.head?.vertices ?? 0;
    await this.cacheVisibility(lights.map((l) => l.number));
    const groups = [0, 1].map((g) => {
      const some = lights.slice(4 * g, 4 * g + 4);
      const strands = new Uint8Array(4 * points), head = new Uint8Array(4 * vertices);
      some.forEach(({ number }, k) => {
        const data = this.cache.get(number);
        for (let i = 0; i < points; i++) strands[4 * i + k] = data[i];
        for (let i = 0; i < vertices; i++) head[4 * i + k] = data[points + i];
      });
      return { strands, head, used: some.length > 0 };
    });
    for (const old of this.visibility ?? []) if (old !== hair.none) gl.deleteTexture(old.texture);
    this.visibility = groups.map((g) => g.used ? hair.perPoint(g.strands, 4) : hair.none);
    picture.head?.setVisibility(groups.map((g) => g.head));
    this.lights = lights;
    viewer.draw();
    viewer.status("");
  }

  // Load the visibility of these lights into `cache`, which keeps those used last.
  async cacheVisibility(numbers) {
    if (numbers.some((n) => !this.cache.has(n))) this.viewer.status("casting shadows");
    for (const number of numbers) {
      const data = this.cache.get(number) ?? new Uint8Array(await net.bytes(`/visibility/${number}`));
      this.cache.delete(number);  // a Map iterates in insertion order
      this.cache.set(number, data);
    }
    for (const old of this.cache.keys()) {
      if (this.cache.size <= MOST_CACHED) break;
      this.cache.delete(old);
    }
  }

  controls() {
    const { viewer, data } = this, { state } = viewer.picture;
    const parts = [element("h2", { textContent: "Light" }), this.dome()];
    const colour = element("input", { type: "color", value: "#ffffff", ariaLabel: "colour of the paint" });
    this.colour = () => [1, 3, 5].map((i) =>
      (parseInt(colour.value.slice(i, i + 2), 16) / 255) ** 2.2);
    const paint = element("button", { textContent: "Paint" });
    paint.setAttribute("aria-pressed", "false");
    paint.addEventListener("click", () => {
      this.painting = !this.painting;
      paint.setAttribute("aria-pressed", String(this.painting));
    });
    const dark = element("button", { textContent: "Dark" });
    dark.addEventListener("click", () => this.set({}));
    const maps = ["studio", "sky"].map((name) => {
      const made = element("button", { textContent: name });
      made.addEventListener("click", () => this.environment(
        () => net.json(net.ofModel(`/environments/${name}`))));
      return made;
    });
    const file = element("input", { type: "file", accept: ".hdr,.exr" });
    file.addEventListener("change", () => file.files[0] && this.drop(file.files[0]));
    parts.push(element("div", { className: "row" }, paint, colour, dark, ...maps),
      labelled("map", file),
      labelled("exposure", slider(-6, 6, 0.1, 0, (stops) => {
        state.exposure = this.base * 2 ** stops;
        viewer.draw();
        if (state.camera) this.set(this.weights);
      })));
    for (const kind of ["dragover", "drop"])
      document.addEventListener(kind, (e) => {
        e.preventDefault();
        if (kind === "drop" && e.dataTransfer.files[0]) this.drop(e.dataTransfer.files[0]);
      });
    if (data.material) {
      parts.push(labelled("indirect", slider(0, 2, 0.05, this.ambient, (v) => {
        this.ambient = v;
        viewer.draw();
      })));
      const notes = ["Colour “lit”: direct light of the fitted fibres (R, TT, TRT and " +
        "higher orders) with shadows. Indirect light, scaled by “indirect”, is path-traced when the view is " +
        "at rest; in motion its mean over the view is added."];
      if (!data.material.one_material) notes.push("The viewer shows one material: the mean of the map.");
      if (data.material.field) notes.push("The viewer does not show the model's reflectance field.");
      notes.push("An environment is shaded by up to 64 lights at rest, eight in motion.");
      parts.push(element("p", { textContent: notes.join(" ") }));
    }
    return parts;
  }

  drop(file) {
    this.environment(() => net.json(
      net.ofModel(`/environments/${encodeURIComponent(file.name)}`), { method: "PUT", body: file }));
  }

  async environment(get) {
    try { await this.set(await get()); } catch (error) { this.viewer.status(error.message); }
  }

  // The dome from the front: its centre is before the face, its rim behind the head.
  dome() {
    const canvas = this.canvas = element("canvas", { id: "dome", width: 520, height: 520, tabIndex: 0 });
    canvas.setAttribute("aria-label", "the dome from the front: drag to move the light");
    const at = ([x, y, z]) => {
      const angle = Math.acos(Math.max(-1, Math.min(1, -y))) / Math.PI;
      const flat = Math.hypot(x, z) || 1;
      return [260 + 248 * angle * x / flat, 260 - 248 * angle * z / flat];
    };
    this.paintDome = () => {
      const pen = canvas.getContext("2d");
      pen.clearRect(0, 0, 520, 520);
      const brightest = Math.max(1e-9, ...Object.values(this.weights).flat());
      this.directions.forEach((d, i) => {
        const w = this.weights[i], [x, y] = at(d);
        pen.beginPath();
        pen.arc(x, y, w ? 9 : 3.5, 0, 2 * Math.PI);
        pen.fillStyle = w
          ? `rgb(${w.map((c) => 40 + 215 * (c / brightest) ** 0.45).join(",")})` : "#4a4e5a";
        pen.fill();
      });
    };
    const move = (e) => {
      if (e.type === "pointermove" && !e.buttons) return;
      const box = canvas.getBoundingClientRect();
      const x = (e.clientX - box.left) / box.width * 2 - 1;
      const y = 1 - (e.clientY - box.top) / box.height * 2;
      const angle = Math.min(1, Math.hypot(x, y)) * Math.PI, turn = Math.atan2(y, x);
      this.towards([Math.sin(angle) * Math.cos(turn), -Math.cos(angle), Math.sin(angle) * Math.sin(turn)],
        this.colour());
    };
    canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); move(e); });
    canvas.addEventListener("pointermove", move);
    this.paintDome();
    return canvas;
  }
}

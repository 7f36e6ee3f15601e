// The page: loads a model coarse to fine and handles input.

import { context } from "./gl.js";
import { Hair, Head } from "./hair.js";
import * as net from "./net.js";
import { Controls, element } from "./controls.js";
import { Picture } from "./picture.js";
import { Orbit, Pinhole } from "./space.js";

const $ = (id) => document.getElementById(id);
const SLOW_MS = 70, FAST_MS = 25;  // a longer frame reduces the number of strands, a shorter one increases it

class Viewer {
  constructor(about) {
    this.about = about;
    this.canvas = $("canvas");
    this.gl = context(this.canvas);
    this.canvas.addEventListener("webglcontextlost", () => {
      this.status("The graphics card lost the picture. Reload the page.");
      $("status").className = "wrong";
    });
    this.picture = new Picture(this.gl, this.canvas);
    const { low, high } = about.strands.model;
    this.orbit = new Orbit(low, high);
    this.picture.box = { middle: [...this.orbit.target], reach: Math.max(this.orbit.reach, 0.2) };
    this.moved = true;
    new ResizeObserver(() => this.resize()).observe($("stage"));
    this.resize();
    this.hands();
    requestAnimationFrame((now) => this.frame(now));
  }

  resize() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const { clientWidth, clientHeight } = $("stage");
    this.canvas.width = Math.max(1, Math.round(clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(clientHeight * ratio));
    this.draw();
  }

  // Redraw in the next frame.
  draw() { this.moved = true; }

  view = (width, height) => {
    const through = this.picture.state.camera;
    return through ? new Pinhole(through).fitted(width, height) : this.orbit.pinhole(width, height);
  };

  frame(now) {
    requestAnimationFrame((t) => this.frame(t));
    const { picture } = this;
    if (!picture.ready()) return;
    if (this.moved) {
      if (this.turning) this.adaptQuality(picture.took);
      this.moved = false;
      picture.moving(this.view);
      this.restAt = now + (this.turning ? 250 : 60);
    } else if (now > this.restAt && !this.turning && this.complete) {
      if (picture.samples === 0 && picture.lit() && this.relight.lights.length)
        this.relight.inView(picture.ofModel(this.view));
      picture.resting(this.view);
    }
  }

  adaptQuality(took) {
    const { state } = this.picture;
    if (took > SLOW_MS) state.quality = Math.max(0.1, state.quality * 0.8);
    else if (took < FAST_MS) state.quality = Math.min(1, state.quality * 1.1);
  }

  status(text) {
    if (text !== undefined) this.message = text;
    const { model } = this.picture.sets;
    const here = model && model.here < model.count
      ? `${model.here.toLocaleString("en")} of ${model.count.toLocaleString("en")} strands` : "";
    $("status").textContent = [here, this.message].filter(Boolean).join(" · ");
  }

  hands() {
    const { canvas, orbit } = this;
    const fingers = new Map();
    let spread = 0;
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      this.pressed = [e.clientX, e.clientY];
      this.turning = true;
    });
    canvas.addEventListener("pointermove", (e) => {
      const before = fingers.get(e.pointerId);
      if (!before) return;
      const dx = e.clientX - before[0], dy = e.clientY - before[1];
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      const places = [...fingers.values()];
      if (places.length === 2) {
        const now = Math.hypot(places[0][0] - places[1][0], places[0][1] - places[1][1]);
        if (spread) orbit.zoom(spread / now);
        spread = now;
        orbit.shift(dx / 2, dy / 2, canvas.clientHeight);
      } else if (this.picture.state.camera) this.leave?.();
      else if (e.shiftKey || e.buttons & 6) orbit.shift(dx, dy, canvas.clientHeight);
      else orbit.turn(dx * 0.4, dy * 0.4);
      this.draw();
    });
    const up = (e) => {
      fingers.delete(e.pointerId);
      spread = 0;
      this.turning = fingers.size > 0;
      const [x, y] = this.pressed ?? [0, 0];
      if (e.type === "pointerup" && Math.hypot(e.clientX - x, e.clientY - y) < 4) this.click?.(e);
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      orbit.zoom(Math.exp(0.0012 * e.deltaY));
      this.draw();
    }, { passive: false });
    canvas.addEventListener("keydown", (e) => {
      const step = e.shiftKey ? 15 : 5;
      const turns = {
        ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
      if (turns[e.key]) orbit.turn(...turns[e.key]);
      else if (e.key === "+" || e.key === "=") orbit.zoom(0.9);
      else if (e.key === "-") orbit.zoom(1 / 0.9);
      else return;
      e.preventDefault();
      this.draw();
    });
  }

  async load() {
    const { about, gl, picture } = this;
    const loading = Object.entries(about.strands).map(([name, description]) => {
      const hair = picture.sets[name] = new Hair(gl, name, description);
      return () => hair.load(() => {
        this.status();
        this.draw();
      });
    });
    await loading[0]();
    if (about.head) picture.head = await Head.load(gl);
    this.draw();
    for (const load of loading.slice(1)) await load();
    this.complete = true;
    this.status();
  }
}

async function begin() {
  try {
    if (!net.model) return await choose();
    const about = await net.json(net.ofModel(""));
    document.title = `${about.name} · hairstage`;
    const viewer = window.viewer = new Viewer(about);
    new Controls($("panel"), viewer);
    await viewer.load();
  } catch (error) {
    if (error instanceof net.Refused) return showTokenForm(error.message);
    $("status").textContent = error.message;
    $("status").className = "wrong";
  }
}

async function choose() {
  const names = await net.json("view/models");
  $("panel").replaceChildren(element("h1", { textContent: "Models" }), ...names.map((name) => element("p", {},
    element("a", { textContent: name, href: `view?model=${encodeURIComponent(name)}` }))));
  if (!names.length) $("status").textContent = "No models.";
}

function showTokenForm(why) {
  const field = element("input",
    { type: "password", name: "token", autocomplete: "current-password", ariaLabel: "token" });
  const form = element("form", {}, element("h1", { textContent: "Log in" }),
    element("p", { textContent: "Your token is printed by: hairstage token show" }), field,
    element("button", { textContent: "Open" }));
  form.addEventListener("submit", async (e) => {
    e.preventDefault();
    try {
      await net.login(field.value.trim());
      location.reload();
    } catch (error) { $("status").textContent = error.message; }
  });
  $("panel").replaceChildren(form);
  $("status").textContent = why;
  field.focus();
}

begin();

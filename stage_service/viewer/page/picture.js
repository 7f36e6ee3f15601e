// Drawing of head, strands and cameras: one sample in motion, a mean of many at rest.

import { Film, Program, buffer } from "./gl.js";
import * as shaders from "./shaders.js";
import { ofLight } from "./space.js";

const MODES = { direction: 0, confidence: 1, root: 2, length: 3, lit: 4 };
const SAMPLES = 48, TURN = 3, LEAST_TURNS = 4;  // consecutive samples per light

const BATCH_MS = 40;  // target duration of a batch of strands
const NO_SLICE = [0, 0, 0, 1];

export class Picture {
  constructor(gl, canvas) {
    Object.assign(this, { gl, canvas, sets: {}, head: null, wires: null, lighting: null });
    this.state = {
      mode: "direction", show: "model", slice: null, opacity: 1, head: true, wires: false,
      exposure: 1, width: 1, quality: 1, camera: null,
    };
    const plain = (lighting) => new Program(
      gl, shaders.STRAND_VERTEX(lighting), shaders.STRAND_FRAGMENT);
    this.plain = plain(shaders.UNLIT);
    this.skin = new Program(gl, shaders.HEAD_VERTEX, shaders.HEAD_FRAGMENT(shaders.UNLIT_HEAD));
    this.wire = new Program(gl, shaders.WIRE_VERTEX, shaders.WIRE_FRAGMENT);
    this.copy = new Program(gl, shaders.SCREEN_VERTEX, shaders.COPY_FRAGMENT);
    this.show = new Program(gl, shaders.SCREEN_VERTEX, shaders.SHOW_FRAGMENT);
    this.film = new Film(gl, gl.RGBA16F, "drawn");
    this.mean = new Film(gl, gl.summed, "none");
    this.shadow = new Film(gl, gl.R32UI, "read");
    this.empty = gl.createVertexArray();
    this.samples = 0;
    this.frames = 0;
    this.batch = 1000;
    this.texels = Math.min(4096, gl.getParameter(gl.MAX_TEXTURE_SIZE));  // side of the shadow map
  }

  // `lighting` provides the uniforms of light; its programs are compiled at its first use.
  setLighting(lighting) {
    this.litStrands ??= new Program(
      this.gl, shaders.STRAND_VERTEX(shaders.LIT), shaders.STRAND_FRAGMENT);
    const skin = (lit) => new Program(this.gl, shaders.HEAD_VERTEX, shaders.HEAD_FRAGMENT(lit));
    this.litSkin ??= skin(shaders.LIT_HEAD);
    this.shadowedSkin ??= skin(shaders.SHADOWED_HEAD);
    this.fibres ??= new Program(this.gl, shaders.FIBRE_VERTEX, shaders.FIBRE_FRAGMENT);
    this.hidingFibres ??= new Program(this.gl, shaders.FIBRE_VERTEX, shaders.FIBRE_SHADOW);
    this.hidingHead ??= new Program(this.gl, shaders.HEAD_VERTEX, shaders.HEAD_SHADOW);
    this.lighting = lighting;
  }

  setWires(lines) {
    const gl = this.gl;
    this.wires = { count: lines.length / 6, array: gl.createVertexArray() };
    gl.bindVertexArray(this.wires.array);
    buffer(gl, gl.ARRAY_BUFFER, new Float32Array(lines));
    for (const i of [0, 1]) {
      gl.enableVertexAttribArray(i);
      gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 24, 12 * i);
    }
    gl.bindVertexArray(null);
  }

  // Draw one frame in motion: lines of one pixel, straight to the page.
  moving(view) {
    this.again();
    this.frames++;
    for (const _ of this.scene(view, { linear: 0, ribbon: 0, shift: [0, 0], film: null }));
    this.mark();
  }

  // Draw part of the next sample of the picture at rest; false when it is complete.
  resting(view) {
    if (this.samples >= this.enough()) return false;
    this.sample ??= this.oneSample(view);
    if (this.sample.next().done) this.sample = null;
    this.mark();
    return true;
  }

  // Discard the samples: the view or the light has changed.
  again() {
    this.samples = 0;
    this.sample = null;
  }

  // Samples until every light has had its turn.
  cycle() { return TURN * ((this.lit() && this.lighting.lights.length) || 1); }

  enough() {
    const cycle = this.cycle();
    const turns = Math.max(LEAST_TURNS, this.lit() ? this.lighting.turns() : 0);
    return cycle * Math.max(Math.ceil(SAMPLES / cycle), turns);
  }

  *oneSample(view) {
    const gl = this.gl, { width, height } = this.canvas, number = this.samples + 1;
    const cycle = this.cycle(), turn = Math.floor(this.samples / cycle), within = this.samples % TURN;
    const round = TURN * turn + within + 1;
    const shift = [radical(round, 2) - 0.5, radical(round, 3) - 0.5];
    const lit = this.lit() && this.lighting.lights.length > 0;
    if (lit && within === 0)
      this.cast = yield* this.castShadow(
        this.lighting.inTurn(Math.floor(this.samples % cycle / TURN), turn), turn + 1);
    const light = lit ? this.cast : null;
    const film = this.film.sized(width, height).frame;
    yield* this.scene(view, { linear: 1, ribbon: this.state.width, shift, film, light });
    this.samples = number;
    gl.disable(gl.DEPTH_TEST);
    gl.bindVertexArray(this.empty);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.mean.sized(width, height).frame);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.BLEND);
    gl.blendColor(0, 0, 0, 1 / number);
    gl.blendFunc(gl.CONSTANT_ALPHA, gl.ONE_MINUS_CONSTANT_ALPHA);
    this.copy.use({ uPicture: this.film.colour });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.BLEND);
    if (number >= 4 && (cycle === TURN || number % cycle === 0)) this.showMean();
  }

  // Draw the shadow map of one light; return the uniforms to shade by it, as bright as all lights.
  *castShadow(from, round) {
    const gl = this.gl, hair = this.sets.model, { low, high } = hair, { lighting } = this;
    const { camera, range, texel } = ofLight(
      from.position, low, high, this.texels);
    const shift = [radical(round, 2) - 0.5, radical(round, 3) - 0.5];
    const lightView = { uMatrix: camera.matrix(...range, shift), uEye: camera.eye, uFocal: camera.K[0][0] };
    const begin = () => {
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadow.frame);
      gl.viewport(0, 0, this.texels, this.texels);
      gl.enable(gl.DEPTH_TEST);
    };
    this.shadow.sized(this.texels, this.texels);
    begin();
    gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    if (this.head) {
      this.hidingHead.use(lightView);
      this.head.draw();
    }
    const shade = lighting.uniforms(from);
    for (let first = 0; first < hair.here;) {
      const count = Math.min(this.batch, hair.here - first);  // may change at every yield
      begin();
      gl.bindVertexArray(this.empty);
      this.hidingFibres.use(
        { ...lightView, ...hair.uniforms(), uRibbon: this.state.width, uSkip: 1, uFirst: first });
      hair.draw(1, 1, count);
      first += count;
      yield;
    }
    return { ...shade, uShadow: lightView.uMatrix, uShadowRange: range,
      uTexel: texel, uShadowDepth: this.shadow.depth, uShadowOf: this.shadow.colour };
  }

  showMean() {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.bindVertexArray(this.empty);
    this.show.use({ uPicture: this.mean.colour, uExposure: this.exposure() });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Set a fence: `ready` checks whether the graphics card has passed it.
  mark() {
    const gl = this.gl;
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.startedAt = performance.now();
    gl.flush();
  }

  // Whether the last commands have finished; `took` is their duration in ms.
  ready() {
    const gl = this.gl;
    if (!this.fence) return true;
    if (gl.getSyncParameter(this.fence, gl.SYNC_STATUS) !== gl.SIGNALED && !gl.isContextLost())
      return false;
    gl.deleteSync(this.fence);
    this.fence = null;
    this.took = performance.now() - this.startedAt;
    if (this.sample) {
      const better = this.batch * Math.min(2, Math.max(0.5, BATCH_MS / Math.max(this.took, 1)));
      this.batch = Math.max(200, Math.min(1e6, Math.round(better)));
    }
    return true;
  }

  exposure() { return this.state.mode === "lit" ? this.state.exposure : 1; }

  // The mean picture: linear radiance and coverage, rows from the bottom.
  radiance() {
    const gl = this.gl, { width, height } = this.canvas;
    const out = new Float32Array(4 * width * height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.mean.frame);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, out);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return out;
  }

  *scene(view, how) {
    const gl = this.gl, { width, height } = this.canvas, { state } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, how.film);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const half = Math.floor(width / 2);
    const parts = state.show === "beside" ? [["model", 0, half], ["truth", half, width - half]]
      : [[state.show, 0, width]];
    for (const [what, left, wide] of parts) {
      const begin = () => {
        gl.bindFramebuffer(gl.FRAMEBUFFER, how.film);
        gl.viewport(left, 0, wide, height);
        gl.enable(gl.DEPTH_TEST);
      };
      const camera = view(wide, height), common = this.common(camera, how);
      begin();
      if (this.head && state.head && state.opacity === 1) {
        const skin = how.light ? this.shadowedSkin : this.lit() ? this.litSkin : this.skin;
        skin.use({ ...common, ...this.light(how) });
        this.head.draw();
      }
      for (const name of what === "over" ? ["model", "truth"] : [what])
        yield* this.strands(name, what === "over", common, how, begin);
      if (this.wires && state.wires) {
        begin();
        this.wire.use(common);
        gl.bindVertexArray(this.wires.array);
        gl.drawArrays(gl.LINES, 0, this.wires.count);
      }
    }
    gl.disable(gl.DEPTH_TEST);
  }

  common(camera, how) {
    const { state, box } = this;
    const away = Math.hypot(...camera.eye.map((x, i) => x - box.middle[i]));
    const near = Math.max(0.02 * box.reach, away - 2.2 * box.reach), far = away + 2.2 * box.reach;
    return {
      uPart: [camera.width, camera.height],
      uMatrix: camera.matrix(near, state.wires ? Math.max(far, 2 * away + 4) : far, how.shift),
      uEye: camera.eye, uFocal: camera.K[0][0], uLinear: how.linear, uExposure: this.exposure(),
      uSlice: state.slice ?? NO_SLICE, uMode: MODES[state.mode],
    };
  }

  // The uniforms of all light, or of the one whose turn it is.
  light(how) { return how.light ?? (this.lit() ? this.lighting.uniforms() : {}); }

  // The view of the model, which may occupy half of the page.
  ofModel(view) {
    const { width, height } = this.canvas;
    return view(this.state.show === "beside" ? Math.floor(width / 2) : width, height);
  }

  lit() { return this.state.mode === "lit" && this.lighting; }

  // At rest: all strands in batches; in motion: as many as the frame rate allows.
  *strands(name, flat, common, how, begin) {
    const gl = this.gl, hair = this.sets[name], { state } = this;
    if (!hair) return;
    const lit = this.lit() && name === "model" && !flat;
    const quality = how.film ? 1 : state.quality;
    const skip = quality < 1 ? 2 : 1, all = Math.ceil(hair.here * quality);
    for (let first = 0; first < all;) {
      const count = how.film ? Math.min(this.batch, all - first) : all;
      begin();
      gl.bindVertexArray(this.empty);
      if (state.opacity < 1) {
        gl.enable(gl.BLEND);
        gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
      }
      (!lit ? this.plain : how.light ? this.fibres : this.litStrands).use({
        ...common, ...hair.uniforms(), uRibbon: how.ribbon, uSkip: skip, uFirst: first,
        uOpacity: state.opacity, ...(lit ? this.light(how) : {}),
        ...(flat ? { uMode: 5, uFlat: name === "truth" ? [0.25, 0.75, 1] : [1, 0.55, 0.15] } : {}),
        ...(this.lit() && !lit && !flat ? { uMode: 0 } : {}),
      });
      hair.draw(how.ribbon, skip, count);
      gl.disable(gl.BLEND);
      first += count;
      if (first < all) yield;
    }
  }
}

function radical(i, base) {  // van der Corput sequence in [0, 1)
  let out = 0;
  for (let f = 1 / base; i > 0; i = Math.floor(i / base), f /= base) out += f * (i % base);
  return out;
}

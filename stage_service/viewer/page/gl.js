// Helpers for WebGL2.

export function context(canvas) {
  const gl = canvas.getContext("webgl2", {
    alpha: true, premultipliedAlpha: true, antialias: false, depth: true,
    powerPreference: "high-performance", preserveDrawingBuffer: true,
  });
  if (!gl) throw new Error("The viewer needs WebGL2, which this browser does not support.");
  const [half, full, blend] = ["EXT_color_buffer_half_float", "EXT_color_buffer_float", "EXT_float_blend"]
    .map((name) => gl.getExtension(name));
  if (!half && !full) throw new Error("The viewer needs float textures to draw into, which this browser does not support.");
  // without EXT_float_blend (tablets), samples are summed in half floats
  gl.summed = full && blend ? gl.RGBA32F : gl.RGBA16F;
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  return gl;
}

export class Program {
  constructor(gl, vertex, fragment) {
    this.gl = gl;
    this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost())
        throw new Error(`shader: ${gl.getShaderInfoLog(shader)}`);
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error(`shader: ${gl.getProgramInfoLog(this.program)}`);
    this.places = new Map();
    const count = gl.getProgramParameter(this.program, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < count; i++) {
      const { name, type } = gl.getActiveUniform(this.program, i);
      this.places.set(name.replace(/\[0\]$/, ""),
        [gl.getUniformLocation(this.program, name), type]);
    }
  }

  // Set uniforms by name; unused ones are skipped. Textures are {texture, kind}.
  use(values) {
    const gl = this.gl;
    gl.useProgram(this.program);
    let unit = 0;
    for (const [name, value] of Object.entries(values)) {
      if (!this.places.has(name)) continue;
      const [place, type] = this.places.get(name);
      if (value?.texture !== undefined) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(value.kind, value.texture);
        gl.uniform1i(place, unit++);
      } else if (type === gl.FLOAT) gl.uniform1fv(place, [value].flat());
      else if (type === gl.INT) gl.uniform1i(place, value);
      else if (type === gl.FLOAT_VEC2) gl.uniform2fv(place, value);
      else if (type === gl.FLOAT_VEC3) gl.uniform3fv(place, value.flat?.(2) ?? value);
      else if (type === gl.FLOAT_VEC4) gl.uniform4fv(place, value.flat?.(2) ?? value);
      else if (type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(place, false, value);
      else throw new Error(`uniform ${name}: no such type here`);
    }
  }
}

export function texture(gl, kind, filter, make) {
  const made = { texture: gl.createTexture(), kind };
  gl.bindTexture(kind, made.texture);
  for (const [name, value] of [
    [gl.TEXTURE_MIN_FILTER, filter], [gl.TEXTURE_MAG_FILTER, filter],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
    [gl.TEXTURE_WRAP_R, gl.CLAMP_TO_EDGE]]) gl.texParameteri(kind, name, value);
  make(gl);
  return made;
}

export function buffer(gl, target, data) {
  const made = gl.createBuffer();
  gl.bindBuffer(target, made);
  gl.bufferData(target, data, gl.STATIC_DRAW);
  return made;
}

// A render target: colour in `format`; `depth` is "none", "drawn" or "read" by shaders.
export class Film {
  constructor(gl, format, depthIs) {
    Object.assign(this, { gl, format, depthIs, width: 0, height: 0 });
    this.frame = gl.createFramebuffer();
  }

  sized(width, height) {
    const gl = this.gl;
    if (width === this.width && height === this.height) return this;
    Object.assign(this, { width, height });
    if (this.colour) gl.deleteTexture(this.colour.texture);
    if (this.buffer) gl.deleteRenderbuffer(this.buffer);
    if (this.depth) gl.deleteTexture(this.depth.texture);
    this.colour = texture(gl, gl.TEXTURE_2D, gl.NEAREST,
      () => gl.texStorage2D(gl.TEXTURE_2D, 1, this.format, width, height));
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(
      gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.colour.texture, 0);
    if (this.depthIs === "read") {
      this.depth = texture(gl, gl.TEXTURE_2D, gl.NEAREST,
        () => gl.texStorage2D(gl.TEXTURE_2D, 1, gl.DEPTH_COMPONENT24, width, height));
      gl.framebufferTexture2D(
        gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.depth.texture, 0);
    } else if (this.depthIs === "drawn") {
      this.buffer = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, this.buffer);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
      gl.framebufferRenderbuffer(
        gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, this.buffer);
    }
    return this;
  }
}

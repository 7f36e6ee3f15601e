// Strands on the graphics card, uploaded in batches: coarse to fine.

import { buffer, texture } from "./gl.js";
import { bytes } from "./net.js";

const WIDE = 4096;  // texels in a row at most; WebGL2 guarantees 2048, all known devices support 4096
const FIRST = 1500, MORE = 12000;

export class Hair {
  constructor(gl, which, description) {
    Object.assign(this, { gl, which, ...description, here: 0, level: null });
    this.widest = Math.min(WIDE, gl.getParameter(gl.MAX_TEXTURE_SIZE));
    this.perRow = Math.max(1, Math.floor(this.widest / this.points));
    this.rows = Math.max(1, Math.ceil(this.count / this.perRow));
    const wide = this.perRow * this.points;
    this.places = texture(gl, gl.TEXTURE_2D, gl.NEAREST,
      () => gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGB16UI, wide, this.rows));
    this.own = texture(gl, gl.TEXTURE_2D, gl.NEAREST,
      () => gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RG32F, this.perRow, this.rows));
    this.none = texture(gl, gl.TEXTURE_2D, gl.NEAREST,
      () => gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R8, 1, 1));
  }

  // Load all strands in batches of texture rows; `shown` is called after each.
  async load(shown) {
    for (let row = 0; row * this.perRow < this.count;) {
      const wanted = row === 0 ? FIRST : MORE;
      const rows = Math.min(Math.max(1, Math.floor(wanted / this.perRow)), this.rows - row);
      const first = row * this.perRow;
      const count = Math.min(rows * this.perRow, this.count - first);
      const data = await bytes(`/strands/${this.which}?first=${first}&count=${count}`);
      this.put(data, row, rows, count);
      row += rows;
      this.here = first + count;
      shown();
    }
  }

  put(data, row, rows, count) {
    const { gl, points, perRow } = this, room = rows * perRow;
    const places = new Uint16Array(room * points * 3);
    places.set(new Uint16Array(data, 0, count * points * 3));
    const at = count * points * 6;
    const tail = new Float32Array(data.slice(at));
    const own = new Float32Array(2 * room);
    for (let i = 0; i < count; i++) { own[2 * i] = tail[i]; own[2 * i + 1] = tail[count + i]; }
    gl.bindTexture(gl.TEXTURE_2D, this.places.texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, perRow * points, rows,
      gl.RGB_INTEGER, gl.UNSIGNED_SHORT, places);
    gl.bindTexture(gl.TEXTURE_2D, this.own.texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, perRow, rows, gl.RG, gl.FLOAT, own);
  }

  // A texture of `channels` values from 0 to 255 per point.
  perPoint(data, channels = 1) {
    const { gl, points, perRow, rows } = this;
    const [inside, format] = channels === 1 ? [gl.R8, gl.RED] : [gl.RGBA8, gl.RGBA];
    const all = new Uint8Array(rows * perRow * points * channels);
    all.set(new Uint8Array(data));
    return texture(gl, gl.TEXTURE_2D, gl.NEAREST, () => {
      gl.texStorage2D(gl.TEXTURE_2D, 1, inside, perRow * points, rows);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, perRow * points, rows, format, gl.UNSIGNED_BYTE, all);
    });
  }

  uniforms() {
    return {
      uPoints: this.places, uStrand: this.own, uLevel: this.level ?? this.none,
      uLow: this.low, uStep: this.step, uLongest: this.longest, uCount: this.points,
      uPerRow: this.perRow,
    };
  }

  // Draw `count` strands as lines of one pixel or as ribbons, every `skip`th point.
  draw(ribbon, skip, count) {
    const gl = this.gl, steps = Math.ceil((this.points - 1) / skip) + 1;
    if (!count) return;
    if (ribbon) gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 2 * steps, count);
    else gl.drawArraysInstanced(gl.LINE_STRIP, 0, steps, count);
  }
}

export class Head {
  static async load(gl) {
    const data = await bytes("/head"), [vertices, faces] = new Uint32Array(data, 0, 2);
    return new Head(gl, new Float32Array(data, 8, 3 * vertices),
      new Uint32Array(data, 8 + 12 * vertices, 3 * faces));
  }

  constructor(gl, vertices, faces) {
    this.gl = gl;
    this.count = faces.length;
    this.vertices = vertices.length / 3;
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    buffer(gl, gl.ARRAY_BUFFER, vertices);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    buffer(gl, gl.ELEMENT_ARRAY_BUFFER, faces);
    gl.bindVertexArray(null);
  }

  // Visibility of eight lights per vertex: two groups of four, 0 to 255.
  setVisibility(groups) {
    const gl = this.gl;
    gl.bindVertexArray(this.array);
    groups.forEach((data, i) => {
      buffer(gl, gl.ARRAY_BUFFER, data);
      gl.enableVertexAttribArray(1 + i);
      gl.vertexAttribPointer(1 + i, 4, gl.UNSIGNED_BYTE, true, 0, 0);
    });
    gl.bindVertexArray(null);
  }

  draw() {
    const gl = this.gl;
    gl.bindVertexArray(this.array);
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(null);
  }
}

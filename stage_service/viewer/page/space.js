// Matrices (column-major, as in WebGL) and the orbiting camera.

const sub = (a, b) => a.map((x, i) => x - b[i]);
export const add = (a, b) => a.map((x, i) => x + b[i]);
export const scale = (a, s) => a.map((x) => x * s);
export const dot = (a, b) => a.reduce((sum, x, i) => sum + x * b[i], 0);
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const length = (a) => Math.hypot(...a);
export const unit = (a) => scale(a, 1 / (length(a) || 1));

function product(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++)
      for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

// A camera as the capture describes it: R (rows right, down, forward), t, K; pixel centres are whole.
export class Pinhole {
  constructor({ R, t, K, width, height, name }) {
    Object.assign(this, { R, t, K, width, height, name });
    this.eye = [0, 1, 2].map((i) => -(R[0][i] * t[0] + R[1][i] * t[1] + R[2][i] * t[2]));
  }

  // World to clip; `shift` in pixels of `height` moves the picture, for samples within a pixel.
  matrix(near, far, shift = [0, 0]) {
    const { R, t, K, width, height } = this;
    const view = new Float32Array(16);
    const sign = [1, -1, -1];  // WebGL looks along -z with y up
    for (let r = 0; r < 3; r++) {
      for (let c = 0; c < 3; c++) view[4 * c + r] = sign[r] * R[r][c];
      view[12 + r] = sign[r] * t[r];
    }
    view[15] = 1;
    const [fx, skew, cx] = K[0], fy = K[1][1], cy = K[1][2];
    const lens = new Float32Array(16);
    lens[0] = 2 * fx / width;
    lens[4] = -2 * skew / width;
    lens[8] = 1 - (2 * (cx + 0.5) + 2 * shift[0]) / width;
    lens[5] = 2 * fy / height;
    lens[9] = (2 * (cy + 0.5) + 2 * shift[1]) / height - 1;
    lens[10] = -(far + near) / (far - near);
    lens[14] = -2 * far * near / (far - near);
    lens[11] = -1;
    return product(lens, view);
  }

  // The same view in about `pixels` pixels.
  resized(pixels) {
    const s = Math.sqrt(pixels / (this.width * this.height));
    const [width, height] = [this.width, this.height].map((n) => Math.ceil(s * n));
    const [x, y] = [width / this.width, height / this.height], [[fx, skew, cx], [, fy, cy]] = this.K;
    const K = [[fx * x, skew * x, (cx + 0.5) * x - 0.5], [0, fy * y, (cy + 0.5) * y - 0.5], [0, 0, 1]];
    return new Pinhole({ ...this, K, width, height });
  }

  // The same view, fitted into an image of another shape.
  fitted(width, height) {
    const s = Math.min(width / this.width, height / this.height);
    const K = [[...this.K[0]], [...this.K[1]], [...this.K[2]]];
    for (const row of [0, 1]) for (const c of [0, 1]) K[row][c] *= s;
    K[0][2] = (this.K[0][2] + 0.5) * s + (width - s * this.width) / 2 - 0.5;
    K[1][2] = (this.K[1][2] + 0.5) * s + (height - s * this.height) / 2 - 0.5;
    return new Pinhole({ ...this, K, width, height });
  }
}

// The view of a box from a light at `eye`, `size` pixels a side, with its range of depths.
export function ofLight(eye, low, high, size) {
  const forward = unit(sub(scale(add(low, high), 0.5), eye));
  const right = unit(cross(forward, Math.abs(forward[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0]));
  const R = [right, cross(forward, right), forward], x = [], y = [], z = [];
  for (let i = 0; i < 8; i++) {
    const corner = sub([0, 1, 2].map((k) => (i >> k & 1 ? high : low)[k]), eye);
    const depth = Math.max(dot(corner, forward), 0.05);
    x.push(dot(corner, right) / depth);
    y.push(dot(corner, R[1]) / depth);
    z.push(depth);
  }
  const [fx, fy] = [x, y].map((v) => (size - 4) / (Math.max(...v) - Math.min(...v)));
  const K = [[fx, 0, 1.5 - fx * Math.min(...x)], [0, fy, 1.5 - fy * Math.min(...y)], [0, 0, 1]];
  const camera = new Pinhole({ R, t: R.map((row) => -dot(row, eye)), K, width: size, height: size });
  const range = [Math.max(0.02, Math.min(...z) - 0.3), Math.max(...z) + 0.01];
  return { camera, range, texel: range[1] / Math.min(fx, fy) };
}

// Turns about `target`; azimuth from +x towards +y, the face looks along -y, z is up.
export class Orbit {
  constructor(low, high) {
    this.target = scale(add(low, high), 0.5);
    this.reach = 0.5 * length(sub(high, low)) || 0.15;
    this.azimuth = -50; this.elevation = 13; this.fov = 24;
    this.distance = 0.95 * this.reach / Math.sin(this.fov * Math.PI / 360);
  }

  pinhole(width, height) {
    const [a, e] = [this.azimuth, this.elevation].map((x) => x * Math.PI / 180);
    const out = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const eye = add(this.target, scale(out, this.distance));
    const forward = scale(out, -1), right = unit(cross(forward, [0, 0, 1]));
    const R = [right, cross(forward, right), forward];
    const f = 0.5 * Math.min(width, height) / Math.tan(this.fov * Math.PI / 360);
    const K = [[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]];
    return new Pinhole({ R, t: R.map((row) => -dot(row, eye)), K, width, height, name: "orbit" });
  }

  turn(dx, dy) {
    this.azimuth -= dx; this.elevation = Math.max(-85, Math.min(85, this.elevation + dy));
  }

  shift(dx, dy, height) {
    const { R } = this.pinhole(height, height);
    const s = 2 * this.distance * Math.tan(this.fov * Math.PI / 360) / height;
    this.target = sub(this.target, add(scale(R[0], dx * s), scale(R[1], dy * s)));
  }

  zoom(factor) {
    this.distance = Math.max(0.3 * this.reach, Math.min(30 * this.reach, this.distance * factor));
  }
}

// The shaders. Radiance is linear until the last pass; places are in metres.

const HEAD = `#version 300 es
precision highp float; precision highp int;
precision highp sampler2D; precision highp usampler2D;
`;

const STRAND = HEAD + `
uniform usampler2D uPoints;
uniform sampler2D uStrand;
uniform vec3 uLow, uEye;
uniform float uStep, uRibbon;
uniform int uCount, uPerRow, uSkip, uFirst;
uniform mat4 uMatrix;
ivec2 texel(int strand, int k) {
  return ivec2((strand % uPerRow) * uCount + k, strand / uPerRow);
}
vec3 place(int strand, int k) { return uLow + uStep * vec3(texelFetch(uPoints, texel(strand, k), 0).xyz); }
vec2 own(int strand) { return texelFetch(uStrand, ivec2(strand % uPerRow, strand / uPerRow), 0).xy; }
int number() {
  return min((uRibbon > 0.0 ? gl_VertexID / 2 : gl_VertexID) * uSkip, uCount - 1);
}
vec3 tangent(int strand, int k) {
  vec3 t = place(strand, min(k + 1, uCount - 1)) - place(strand, max(k - 1, 0));
  return t / max(length(t), 1e-9);
}
vec3 across(vec3 t, vec3 view) {  // to the right of the strand in the view
  vec3 side = cross(t, view);
  float wide = length(side);
  return wide > 1e-4 ? side / wide : vec3(0.0);
}
`;

export const STRAND_VERTEX = (lighting) => STRAND + `
uniform sampler2D uLevel;
uniform vec3 uFlat;
uniform float uLongest, uExposure;
uniform int uMode;
out vec3 vColour, vPlace;
${lighting}
vec3 ramp(float x) {  // dark blue, teal, yellow: lightness grows with x
  x = clamp(x, 0.0, 1.0);
  vec3 c = mix(vec3(0.27, 0.0, 0.33), vec3(0.13, 0.57, 0.55), min(2.0 * x, 1.0));
  return mix(c, vec3(0.99, 0.91, 0.14), max(2.0 * x - 1.0, 0.0));
}
vec3 hue(vec3 d) {
  float a = atan(d.y, d.x);
  vec3 c = 0.5 + 0.5 * cos(a + vec3(0.0, -2.094, 2.094));
  return mix(c, vec3(1.0), 0.35 * clamp(d.z, 0.0, 1.0)) * (0.75 + 0.25 * d.z);
}
void main() {
  int strand = uFirst + gl_InstanceID, k = number();
  vec3 p = place(strand, k), t = tangent(strand, k), view = normalize(uEye - p), q = p;
  if (uRibbon > 0.0)
    q += across(t, view) * own(strand).y * uRibbon * (gl_VertexID % 2 == 0 ? 1.0 : -1.0);
  vec3 c = vec3(1.0);
  if (uMode == 0) c = 0.5 + 0.5 * t;
  else if (uMode == 1) c = ramp(texelFetch(uLevel, texel(strand, k), 0).x);
  else if (uMode == 2) c = hue(normalize(place(strand, 0) - uLow - 32767.0 * uStep));
  else if (uMode == 3) c = ramp(own(strand).x / uLongest);
  else if (uMode == 5) c = uFlat;
  if (uMode == 4) c = lit(p, t, view, strand, texel(strand, k));
  else c = pow(c, vec3(2.2)) * (0.35 + 0.65 * length(cross(t, view))) / uExposure;  // the same in any
  vColour = c;
  vPlace = p;
  gl_Position = uMatrix * vec4(q, 1.0);
}`;

// A round fibre: a ribbon facing the eye, with the offset from the fibre's axis per fragment. The ribbon
// is at least two pixels wide, and fragments beside the fibre are discarded: some rasterisers snap corners
// to a grid of 1/16 pixel, which loses thinner ribbons.
export const FIBRE_VERTEX = STRAND + `
uniform float uFocal;  // pixels
out vec3 vPlace, vTangent, vFacing;
out float vAcross, vRadius;
flat out uint vStrand;
void main() {
  int strand = uFirst + gl_InstanceID, k = number();
  vec3 p = place(strand, k), view = normalize(uEye - p);
  vTangent = tangent(strand, k);
  vRadius = own(strand).y * uRibbon;
  float pixel = (uMatrix * vec4(p, 1.0)).w / uFocal;
  vAcross = max(1.0, pixel / max(vRadius, 1e-9)) * (gl_VertexID % 2 == 0 ? 1.0 : -1.0);
  vec3 side = across(vTangent, view);
  vFacing = cross(side, vTangent);
  vPlace = p + vAcross * vRadius * side;
  vStrand = uint(strand);
  gl_Position = uMatrix * vec4(vPlace, 1.0);
}`;

const FIBRE = HEAD + `
in vec3 vPlace, vTangent, vFacing;
in float vAcross, vRadius;
flat in uint vStrand;
uniform mat4 uMatrix;
vec3 surface() {  // and the depth of the round fibre, not of the ribbon
  if (abs(vAcross) > 1.0) discard;
  vec3 p = vPlace + vFacing * vRadius * sqrt(max(1.0 - vAcross * vAcross, 0.0));
  vec4 clip = uMatrix * vec4(p, 1.0);
  gl_FragDepth = 0.5 + 0.5 * clip.z / clip.w;
  return p;
}
`;

export const FIBRE_SHADOW = FIBRE + `
out uint oStrand;
void main() { surface(); oStrand = vStrand; }`;

export const HEAD_SHADOW = HEAD + `
out uint oStrand;
void main() { oStrand = 0xffffffffu; }`;

export const UNLIT = `
vec3 lit(vec3 p, vec3 t, vec3 view, int strand, ivec2 at) { return vec3(0.0); }`;

const SHOWN = `
uniform float uExposure;
uniform int uLinear;
vec3 shown(vec3 c) {
  c = clamp(c * uExposure, 0.0, 1.0);
  return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
}
`;

export const STRAND_FRAGMENT = HEAD + SHOWN + `
in vec3 vColour, vPlace;
uniform vec4 uSlice;
uniform float uOpacity;
out vec4 oColour;
void main() {
  if (dot(uSlice.xyz, vPlace) > uSlice.w) discard;
  vec3 c = uLinear == 1 ? vColour : shown(vColour);
  oColour = vec4(c * uOpacity, uOpacity);
}`;

export const HEAD_VERTEX = HEAD + `
layout(location = 0) in vec3 aPlace;
layout(location = 1) in vec4 aVisible0;
layout(location = 2) in vec4 aVisible1;
uniform mat4 uMatrix;
out vec3 vPlace;
out vec4 vVisible0, vVisible1;
void main() {
  vPlace = aPlace; vVisible0 = aVisible0; vVisible1 = aVisible1;
  gl_Position = uMatrix * vec4(aPlace, 1.0);
}`;

export const HEAD_FRAGMENT = (lighting) => HEAD + SHOWN + `
in vec3 vPlace;
in vec4 vVisible0, vVisible1;
uniform vec3 uEye;
uniform vec4 uSlice;
uniform int uMode;
out vec4 oColour;
${lighting}
void main() {
  if (dot(uSlice.xyz, vPlace) > uSlice.w) discard;
  vec3 n = normalize(cross(dFdx(vPlace), dFdy(vPlace)));
  vec3 view = normalize(uEye - vPlace);
  if (dot(n, view) < 0.0) n = -n;
  vec3 c = vec3(0.11, 0.105, 0.1) * (0.25 + 0.75 * dot(n, view));
  if (uMode == 4) c = skin(vPlace, n, vVisible0, vVisible1);
  oColour = vec4(uLinear == 1 ? c : shown(c), 1.0);
}`;

export const UNLIT_HEAD = `
vec3 skin(vec3 p, vec3 n, vec4 a, vec4 b) { return vec3(0.0); }`;

export const WIRE_VERTEX = HEAD + `
layout(location = 0) in vec3 aPlace;
layout(location = 1) in vec3 aColour;
uniform mat4 uMatrix;
out vec3 vColour;
void main() { vColour = aColour; gl_Position = uMatrix * vec4(aPlace, 1.0); gl_PointSize = 5.0; }`;

export const WIRE_FRAGMENT = HEAD + `
uniform float uExposure;
uniform int uLinear;
in vec3 vColour;
out vec4 oColour;
void main() { oColour = vec4(uLinear == 1 ? pow(vColour, vec3(2.2)) / uExposure : vColour, 1.0); }`;

export const SCREEN_VERTEX = HEAD + `
out vec2 vAt;
void main() {
  vAt = vec2(gl_VertexID % 2, gl_VertexID / 2) * 2.0;
  gl_Position = vec4(2.0 * vAt - 1.0, 0.0, 1.0);
}`;

export const COPY_FRAGMENT = HEAD + `
uniform sampler2D uPicture;
in vec2 vAt;
out vec4 oColour;
void main() { oColour = texture(uPicture, vAt); }`;

export const SHOW_FRAGMENT = HEAD + SHOWN + `
uniform sampler2D uPicture;
in vec2 vAt;
out vec4 oColour;
void main() {
  vec4 c = texture(uPicture, vAt);
  oColour = vec4(shown(c.rgb), c.a);
}`;

const LONGITUDINAL = `
float scaledI0(float x) {  // I0(x) exp(-x): Abramowitz and Stegun 9.8.1, 9.8.2
  if (x < 3.75) {
    float y = x * x / 14.0625;
    return exp(-x) * (1.0 + y * (3.5156229 + y * (3.0899424 + y * (1.2067492 + y * (0.2659732
      + y * (0.0360768 + y * 0.0045813))))));
  }
  float z = 3.75 / x;
  return (0.39894228 + z * (0.01328592 + z * (0.00225319 + z * (-0.00157565 + z * (0.00916281
    + z * (-0.02057706 + z * (0.02635537 + z * (-0.01647633 + z * 0.00392377)))))))) * inversesqrt(x);
}
float longitudinal(float si, float ci, float so, float co, float v) {
  float chord = (ci - co) * (ci - co) + (si + so) * (si + so), r = 1.0 / v;
  return scaledI0(ci * co * r) * exp(-0.5 * chord * r) * r / (1.0 - exp(-2.0 * r));
}
struct Tilted { vec4 sines, cosines; };
Tilted tilted(float si, float ci, float tilt) {  // inclinations for R, TT, TRT and higher orders
  float s1 = sin(tilt), c1 = cos(tilt), s2 = 2.0 * s1 * c1, c2 = c1 * c1 - s1 * s1;
  float s4 = 2.0 * s2 * c2, c4 = c2 * c2 - s2 * s2;
  return Tilted(vec4(si * c2 + ci * s2, si * c1 - ci * s1, si * c4 - ci * s4, si),
    vec4(abs(ci * c2 - si * s2), abs(ci * c1 + si * s1), abs(ci * c4 + si * s4), ci));
}
`;

// Far-field direct light of the hair's BSDF: M_p of each lobe, times a table of the mean of A_p N_p over
// the fibre's width (appearance/bsdf/far_field.py), times the light's visibility.
const LIGHTS = `
uniform int uLights;
uniform vec3 uLightAt[8], uLightPower[8];
uniform vec3 uHairIndirect, uHeadIndirect;  // means over the last traced view
uniform float uAmbient;
vec3 incoming(int i, vec3 p, out vec3 l) {
  l = uLightAt[i] - p;
  float d2 = dot(l, l);
  l *= inversesqrt(d2);
  return uLightPower[i] / d2;
}
`;

export const LIT = LIGHTS + `
uniform sampler2D uVisible0, uVisible1, uTable;
uniform vec4 uVariance;
uniform float uTilt;
uniform vec2 uGrid;  // cosines, turns
${LONGITUDINAL}vec3 azimuthal(int lobe, float cosine, float turn) {
  float row = clamp(cosine * uGrid.x, 0.5, uGrid.x - 0.5) + float(lobe) * uGrid.x;
  float column = clamp(turn / 3.14159265 * uGrid.y, 0.5, uGrid.y - 0.5);
  return texture(uTable, vec2(column / uGrid.y, row / (4.0 * uGrid.x))).rgb;
}
vec3 lit(vec3 p, vec3 t, vec3 view, int strand, ivec2 at) {
  float si = clamp(dot(t, view), -1.0, 1.0), ci = sqrt(max(1.0 - si * si, 1e-8));
  Tilted leans = tilted(si, ci, uTilt);
  vec4 visible0 = texelFetch(uVisible0, at, 0), visible1 = texelFetch(uVisible1, at, 0);
  vec3 across = (view - si * t) / ci, sum = uAmbient * uHairIndirect;
  for (int i = 0; i < uLights; i++) {
    vec3 l;
    vec3 power = incoming(i, p, l);
    float visible = i < 4 ? visible0[i] : visible1[i - 4];
    if (visible == 0.0) continue;
    float so = clamp(dot(t, l), -1.0, 1.0), co = sqrt(max(1.0 - so * so, 1e-8));
    float turn = acos(clamp(dot(across, l - so * t) / co, -1.0, 1.0));
    vec3 f = vec3(0.0);
    for (int lobe = 0; lobe < 4; lobe++)
      f += longitudinal(leans.sines[lobe], leans.cosines[lobe], so, co, uVariance[lobe])
        * azimuthal(lobe, ci, turn);
    sum += visible * power * f;
  }
  return sum;
}`;

// Shadow map: depth and strand of the first hit in each texel; a strand casts no shadow on itself. Texels
// are shifted between samples, so that their mean shows none.
const SHADOW = `
uniform sampler2D uShadowDepth;
uniform usampler2D uShadowOf;
uniform mat4 uShadow;
uniform vec2 uShadowRange;  // near, far
bool hidden(vec3 p, uint mine, float slack) {
  vec4 clip = uShadow * vec4(p, 1.0);
  vec3 at = 0.5 + 0.5 * clip.xyz / clip.w;
  if (any(lessThan(at, vec3(0.0))) || any(greaterThan(at, vec3(1.0)))) return false;
  ivec2 size = textureSize(uShadowDepth, 0), texel = min(ivec2(at.xy * vec2(size)), size - 1);
  if (texelFetch(uShadowOf, texel, 0).x == mine) return false;
  float n = uShadowRange.x, f = uShadowRange.y;
  float first = n * f / (f - texelFetch(uShadowDepth, texel, 0).x * (f - n));
  return first < n * f / (f - at.z * (f - n)) - slack;
}
`;

// Indirect light traced for this view: radiance times coverage by hair (or head), and coverage; outside
// of it the mean.
const IN_VIEW = `
uniform vec2 uPart;  // pixels that the view is drawn on
vec3 between(sampler2D traced, vec3 mean) {
  vec4 found = texture(traced, vec2(gl_FragCoord.x, uPart.y - gl_FragCoord.y) / uPart);
  return found.a > 1e-3 && gl_FragCoord.x < uPart.x ? uAmbient * found.rgb / found.a : uAmbient * mean;
}
`;

// Near-field direct light of the hair's BSDF at the fragment's offset: appearance/bsdf/lobes.py.
export const FIBRE_FRAGMENT = FIBRE + LIGHTS + LONGITUDINAL + SHADOW + IN_VIEW + `
uniform vec4 uSlice, uVariance;
uniform float uOpacity, uTilt, uEta, uLogistic;
uniform vec3 uEye, uAbsorption;
uniform sampler2D uOfHair;
out vec4 oColour;
const float PI = 3.14159265;
float turned(float x) {  // N_p: a logistic, trimmed to one turn
  x -= 2.0 * PI * round(x / (2.0 * PI));
  float z = exp(-abs(x) / uLogistic);
  return z / (uLogistic * (1.0 + z) * (1.0 + z) * tanh(min(0.5 * PI / uLogistic, 20.0)));
}
vec3 fibre(vec3 t, vec3 view, vec3 l) {
  float si = clamp(dot(t, view), -1.0, 1.0), ci = sqrt(max(1.0 - si * si, 1e-8));
  float so = clamp(dot(t, l), -1.0, 1.0), co = sqrt(max(1.0 - so * so, 1e-8));
  vec3 facing = (view - si * t) / ci;
  float turn = atan(-dot(l, cross(t, facing)), dot(l, facing));
  float h = clamp(vAcross, -1.0, 1.0), up = sqrt(max(1.0 - h * h, 0.0)), gamma = asin(h);
  float q = (uEta - 1.0) * (uEta + 1.0), mu = ci * up, n = uEta * uEta;
  float w = sqrt(q + mu * mu), s = mu + w, p = n * mu + w;
  float rs = q / (s * s), rp = q * ((n + 1.0) * mu * mu - 1.0) / (p * p);
  float F = 0.5 * (rs * rs + rp * rp), through = 2.0 * mu * w * (1.0 / (s * s) + n / (p * p));
  float inside = atan(h * ci, w);
  vec3 T = exp(-uAbsorption * (2.0 * uEta * w / (q + ci * ci)));
  vec3 tt = through * through * T, trt = tt * F * T;
  vec3 rest = trt * F * T / max(1.0 - F * T, 1e-6);
  Tilted leans = tilted(si, ci, uTilt);
  float first = turn + 2.0 * gamma;
  return longitudinal(leans.sines.x, leans.cosines.x, so, co, uVariance.x) * F * turned(first)
    + longitudinal(leans.sines.y, leans.cosines.y, so, co, uVariance.y) * tt
      * turned(first - 2.0 * inside - PI)
    + longitudinal(leans.sines.z, leans.cosines.z, so, co, uVariance.z) * trt
      * turned(first - 4.0 * inside)
    + longitudinal(leans.sines.w, leans.cosines.w, so, co, uVariance.w) * rest * (0.5 / PI);
}
void main() {
  vec3 p = surface(), l;
  if (dot(uSlice.xyz, p) > uSlice.w) discard;
  vec3 power = incoming(0, p, l), c = between(uOfHair, uHairIndirect);
  if (!hidden(p, vStrand, 2e-5)) c += power * fibre(normalize(vTangent), normalize(uEye - p), l);
  oColour = vec4(c * uOpacity, uOpacity);
}`;

export const LIT_HEAD = LIGHTS + `
uniform vec3 uSkin;
vec3 skin(vec3 p, vec3 n, vec4 visible0, vec4 visible1) {
  vec3 sum = uAmbient * uHeadIndirect;
  for (int i = 0; i < uLights; i++) {
    vec3 l;
    vec3 power = incoming(i, p, l);
    float visible = i < 4 ? visible0[i] : visible1[i - 4];
    sum += power * visible * max(dot(n, l), 0.0) / 3.14159265 * uSkin;
  }
  return sum;
}`;

// The same with one light's shadow map instead of visibility per vertex.
export const SHADOWED_HEAD = LIGHTS + SHADOW + IN_VIEW + `
uniform vec3 uSkin;
uniform sampler2D uOfHead;
uniform float uTexel;  // metres
vec3 skin(vec3 p, vec3 n, vec4 visible0, vec4 visible1) {
  vec3 l, power = incoming(0, p, l);
  float cosine = max(dot(n, l), 0.0);
  bool dark = cosine == 0.0 || hidden(p + 2.0 * uTexel * n, 0xfffffffeu, 2.0 * uTexel);
  return power * (dark ? 0.0 : cosine / 3.14159265) * uSkin + between(uOfHead, uHeadIndirect);
}`;

"use strict";
// GLSL of the three panes. Directions are in sensor axes: x forward, y left, z up.

const COMMON = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
const float PI = 3.14159265358979;
uniform sampler2D colour, classes, depth, photo, confidence, source;
uniform sampler2D table;    // 256 x 4: RGB of each class, each depth code, each step of confidence, each camera
uniform vec3 ground;        // colour of the page
uniform int chosen;         // bits of the classes to show; 0: all
uniform vec4 cylinder;      // tangents of the upper and the lower edge; azimuth of the left edge, width: radians
uniform float detail;          // level of detail of colours: log2 of panorama pixels per screen pixel
uniform vec2 depthRange;    // metres of the codes 1 and 255, which are log-spaced

// The arc tangent of y / x to 2e-8 (Abramowitz and Stegun 4.4.49); that of some GPUs is half a panorama pixel off.
float angle(float y, float x) {
  float a = min(abs(x), abs(y)) / max(max(abs(x), abs(y)), 1e-20), s = a * a;
  float r = a * (((((((( .0028662257 * s - .0161657367) * s + .0429096138) * s - .0752896400) * s + .1065626393) * s
    - .1420889944) * s + .1999355085) * s - .3333314528) * s + 1.);
  if (abs(y) > abs(x)) r = PI / 2. - r;
  if (x < 0.) r = PI - r;
  return y < 0. ? -r : r;
}

// Where a direction lies in the panorama, (0, 0) at its top left, (1, 1) at its bottom right: columns are azimuth,
// rows are the tangent of elevation.
vec2 place(vec3 d) {
  float turn = (cylinder.z - angle(d.y, d.x)) / (2. * PI);
  return vec2((turn - floor(turn)) * 2. * PI / cylinder.w,
    (cylinder.x - d.z / max(length(d.xy), 1e-9)) / (cylinder.x - cylinder.y));
}

bool inside(vec2 at) { return at.x <= 1. && at.y >= 0. && at.y < 1.; }

int code(sampler2D layer, vec2 at) { return int(textureLod(layer, at, 0.).r * 255. + .5); }

bool left_out(int id) { return chosen != 0 && ((chosen >> id) & 1) == 0; }

vec3 painted(vec2 at, int layer) {
  if (layer == 1) {
    int id = code(classes, at);
    vec3 rgb = texelFetch(table, ivec2(id, 0), 0).rgb;
    return left_out(id) ? mix(ground, vec3(dot(rgb, vec3(1. / 3.))), .2) : rgb;
  }
  if (layer == 2) return texelFetch(table, ivec2(code(depth, at), 1), 0).rgb;
  if (layer == 4) return texelFetch(table, ivec2(code(confidence, at), 2), 0).rgb;
  vec3 rgb = textureLod(colour, at, detail).rgb;
  if (layer == 0) return rgb;
  if (layer == 5) {
    int number = code(source, at);
    return number == 0 ? vec3(dot(rgb, vec3(.15, .3, .05))) : mix(rgb, texelFetch(table, ivec2(number, 3), 0).rgb, .4);
  }
  vec4 sample_ = textureLod(photo, at, detail);
  return mix(rgb * .3, sample_.rgb, sample_.a);
}
`;

const TRIANGLE = `#version 300 es
void main() { gl_Position = vec4(gl_VertexID == 1 ? 3. : -1., gl_VertexID == 2 ? 3. : -1., 0., 1.); }`;

const LOOK = COMMON + `
uniform vec4 pane;          // left, bottom, width, height in pixels of the canvas
uniform mat3 axes;          // columns: forward, left, up of the one who looks
uniform float focal;        // pixels
uniform float boundary;     // canvas x from which on the second layer is drawn
uniform ivec2 layers;
out vec4 pixel;
void main() {
  vec2 q = gl_FragCoord.xy - pane.xy - pane.zw / 2.;
  vec2 at = place(axes * vec3(focal, -q.x, q.y));
  pixel = vec4(inside(at) ? painted(at, gl_FragCoord.x < boundary ? layers.x : layers.y) : ground, 1.);
}`;

const MAP = COMMON + `
uniform vec4 pane;
uniform mat3 axes;
uniform vec3 view;          // width, height and focal length of the view that is outlined
uniform int layer;
out vec4 pixel;
void main() {
  vec2 at = (gl_FragCoord.xy - pane.xy) / pane.zw;
  at.y = 1. - at.y;
  float azimuth = cylinder.z - at.x * cylinder.w;
  vec3 d = vec3(cos(azimuth), sin(azimuth), mix(cylinder.x, cylinder.y, at.y)) * axes;  // in the viewer's axes
  vec2 edge = abs(d.yz / max(d.x, 1e-6)) * view.z * 2. / view.xy;  // 1 on the view's border
  float out_ = d.x <= 0. ? 2. : max(edge.x, edge.y);
  float border = 1. - smoothstep(0., 1.5, abs(out_ - 1.) / max(fwidth(out_), 1e-6));
  vec3 rgb = painted(at, layer) * (out_ > 1. ? .5 : 1.);
  pixel = vec4(mix(rgb, vec3(1.), out_ < 1.3 ? border : 0.), 1.);
}`;

const CLOUD_VERTICES = COMMON + `
uniform mat4 projection;
uniform vec3 origin;        // of the panorama, metres
uniform float size;         // of a point one metre away, pixels
uniform float enlarged;     // by the one who looks
uniform int layer;          // or 10: height, 11: intensity, 12: distance
uniform vec2 heights;       // metres of the ends of the colours
layout(location = 0) in vec3 centimetres;
layout(location = 1) in float intensity;
out vec3 rgb;
vec3 ramp(float share) { return texelFetch(table, ivec2(int(clamp(share, 0., 1.) * 20. + .5), 2), 0).rgb; }
void main() {
  vec3 point = centimetres / 100., d = point - origin;
  gl_Position = projection * vec4(point, 1.);
  gl_PointSize = clamp(size / gl_Position.w, 1.5, 9.) * enlarged;
  vec2 at = place(d);
  int steps = code(depth, at);
  float metres = depthRange.x * pow(depthRange.y / depthRange.x, float(steps - 1) / 254.);
  bool occluded = steps > 0 && length(d) > OCCLUDED;
  bool seen = inside(at) && !occluded;
  if (layer == 10) rgb = ramp((point.z - heights.x) / (heights.y - heights.x));
  else if (layer == 11) rgb = ramp(intensity);
  else if (layer == 12) rgb = texelFetch(table, ivec2(1. + 254. * clamp(log(length(d) / depthRange.x)
    / log(depthRange.y / depthRange.x), 0., 1.), 1), 0).rgb;
  else if (!seen) rgb = vec3(128. / 255.);
  else if (layer == 3 && textureLod(photo, at, 0.).a < .5) rgb = painted(at, 0);
  else rgb = painted(at, layer);
  if (chosen != 0 && (!seen || left_out(code(classes, at)))) gl_Position = vec4(2., 2., 2., 1.);
}`;

const GRID_VERTICES = `#version 300 es
uniform mat4 projection;
layout(location = 0) in vec3 metres;
void main() { gl_Position = projection * vec4(metres, 1.); }`;

const GRID_PIXELS = `#version 300 es
precision highp float;
uniform vec3 line;
out vec4 pixel;
void main() { pixel = vec4(line, 1.); }`;

const CLOUD_PIXELS = `#version 300 es
precision highp float;
in vec3 rgb;
out vec4 pixel;
void main() {
  if (length(gl_PointCoord - .5) > .5) discard;
  pixel = vec4(rgb, 1.);
}`;

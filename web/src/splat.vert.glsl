// Projection of Gaussians: EWA splatting as in common/raster/project.py (Zwicker et al. 2001): the covariance in the image is
// J R S R^T J^T + 0.3 px^2, with J at slopes clamped to 15 % outside the image. One quad per Gaussian, as large as alpha >= 1/255.
precision highp float;
precision highp int;
precision highp usampler2D;

uniform mat4 viewMatrix; // set by three.js: T_view_map; view: x right, y up, z backward
uniform mat4 projectionMatrix;
uniform usampler2D gaussians; // three texels per Gaussian: see codec.js
uniform int perRow; // Gaussians in a row of the texture
uniform vec2 size; // of the image, px
uniform int shading; // 0 colour, 1 depth, 2 uncertainty
uniform vec2 range; // of the shaded quantity: its logarithm for the uncertainty

in vec2 corner; // of the quad, -1 or 1
in uint order; // Gaussian of this instance

flat out vec4 colour;
out vec2 offset; // from the centre, in standard deviations

const float BLUR_PX2 = 0.3;
const float ALPHA_MIN = 1.0 / 255.0;
const float NEAR_M = 0.05;
const vec4 OUTSIDE = vec4(0.0, 0.0, 2.0, 1.0);

// Turbo (Mikhailov 2019), polynomial of degree 5; t = 0 is blue, 1 is red.
vec3 turbo(float t) {
  const vec4 r4 = vec4(0.13572138, 4.61539260, -42.66032258, 132.13108234);
  const vec4 g4 = vec4(0.09140261, 2.19418839, 4.84296658, -14.18503333);
  const vec4 b4 = vec4(0.10667330, 12.64194608, -60.58204836, 110.36276771);
  const vec2 r2 = vec2(-152.94239396, 59.28637943), g2 = vec2(4.27729857, 2.82956604), b2 = vec2(-89.90310912, 27.34824973);
  t = clamp(t, 0.0, 1.0);
  vec4 v4 = vec4(1.0, t, t * t, t * t * t);
  vec2 v2 = v4.zw * v4.z;
  return clamp(vec3(dot(v4, r4) + dot(v2, r2), dot(v4, g4) + dot(v2, g2), dot(v4, b4) + dot(v2, b2)), 0.0, 1.0);
}

void main() {
  gl_Position = OUTSIDE;
  int i = int(order);
  ivec2 at = ivec2((i % perRow) * 3, i / perRow);
  uvec4 first = texelFetch(gaussians, at, 0);
  vec3 view = (viewMatrix * vec4(uintBitsToFloat(first.xyz), 1.0)).xyz;
  float depth = -view.z;
  if (depth <= NEAR_M) return;
  vec4 second = uintBitsToFloat(texelFetch(gaussians, at + ivec2(1, 0), 0));
  vec4 third = uintBitsToFloat(texelFetch(gaussians, at + ivec2(2, 0), 0));

  vec4 clip = projectionMatrix * vec4(view, 1.0);
  vec2 ndc = clip.xy / clip.w;
  vec2 focal = 0.5 * size * vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
  // Slopes x/depth and y/depth of the point, clamped 15 % of the image size outside the image.
  vec2 shift = vec2(projectionMatrix[2][0], projectionMatrix[2][1]);
  vec2 slope = (clamp(ndc, -1.3, 1.3) + shift) / vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
  mat3 R = mat3(viewMatrix);
  vec3 back = vec3(R[0][2], R[1][2], R[2][2]);
  vec3 v0 = (focal.x / depth) * (vec3(R[0][0], R[1][0], R[2][0]) + slope.x * back); // rows of J R
  vec3 v1 = (focal.y / depth) * (vec3(R[0][1], R[1][1], R[2][1]) + slope.y * back);
  mat3 S = mat3(second.x, second.y, second.z, second.y, second.w, third.x, second.z, third.x, third.y);
  float a = dot(v0, S * v0) + BLUR_PX2, b = dot(v0, S * v1), d = dot(v1, S * v1) + BLUR_PX2;

  float opacity = clamp(float(first.w >> 24u) / 255.0, 0.001, 0.999);
  if (opacity < ALPHA_MIN) return;
  float reach = sqrt(2.0 * log(opacity / ALPHA_MIN)); // standard deviations where alpha is 1/255
  float middle = 0.5 * (a + d), radius = length(vec2(0.5 * (a - d), b));
  float major = middle + radius, minor = max(middle - radius, BLUR_PX2);
  vec2 axis = abs(b) > 1e-6 * major ? normalize(vec2(b, major - a)) : (a >= d ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  vec2 px = reach * (corner.x * sqrt(major) * axis + corner.y * sqrt(minor) * vec2(-axis.y, axis.x));
  offset = reach * corner;
  gl_Position = vec4(clip.xy + 2.0 * px / size * clip.w, clip.zw);

  vec3 rgb = vec3(float(first.w & 255u), float((first.w >> 8u) & 255u), float((first.w >> 16u) & 255u)) / 255.0;
  if (shading == 1) rgb = turbo((range.y - depth) / (range.y - range.x));
  else if (shading == 2) rgb = turbo((log(third.z) - range.x) / (range.y - range.x));
  colour = vec4(rgb, opacity);
}

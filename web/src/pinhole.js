// Poses and pinhole cameras. Camera frame: x right, y down, z forward (as in the rest of BeamSplat); pixel centres have
// integer coordinates. Matrices are row-major arrays; WebGL's view frame is x right, y up, z backward.

/** @typedef {[number, number, number]} Point */

/**
 * A pinhole camera at a pose. `T_map_camera` is row-major [16].
 * @typedef {{T_map_camera: number[], fx: number, fy: number, cx: number, cy: number, width: number, height: number}} Pinhole
 */

export const NEAR_M = 0.05; // near plane, as in common/raster/layout.py
export const FAR_M = 1000;
const FIELD_OF_VIEW = (60 * Math.PI) / 180; // vertical, of the window

/** Focal length (px) of a window. @param {number} height px */
export const focalPx = (height) => height / 2 / Math.tan(FIELD_OF_VIEW / 2);

/** @param {Point} a @param {Point} b @returns {number} m */
export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

/** Return the origin of a frame. @param {ArrayLike<number>} T row-major [16] @returns {Point} */
export const origin = (T) => [T[3], T[7], T[11]];

/** Return the third column, the direction of z. @param {ArrayLike<number>} T row-major [16] @returns {Point} */
export const forward = (T) => [T[2], T[6], T[10]];

/** Return the inverse of a rigid transform. @param {ArrayLike<number>} T row-major [16] @returns {number[]} row-major [16] */
export function inverse(T) {
  const t = [0, 1, 2].map((k) => -(T[k] * T[3] + T[4 + k] * T[7] + T[8 + k] * T[11]));
  return [T[0], T[4], T[8], t[0], T[1], T[5], T[9], t[1], T[2], T[6], T[10], t[2], 0, 0, 0, 1];
}

/** Return T applied to a point. @param {ArrayLike<number>} T row-major [16] @param {ArrayLike<number>} p @returns {Point} */
export const transform = (T, p) => [
  T[0] * p[0] + T[1] * p[1] + T[2] * p[2] + T[3],
  T[4] * p[0] + T[5] * p[1] + T[6] * p[2] + T[7],
  T[8] * p[0] + T[9] * p[1] + T[10] * p[2] + T[11],
];

/**
 * Return the pose of a camera that looks along (yaw, pitch) without roll.
 * @param {ArrayLike<number>} eye map frame, m
 * @param {number} yaw rad, from x to y
 * @param {number} pitch rad, positive looks up
 * @returns {number[]} T_map_camera, row-major [16]
 */
export function lookingPose(eye, yaw, pitch) {
  const c = Math.cos(yaw), s = Math.sin(yaw), cp = Math.cos(pitch), sp = Math.sin(pitch);
  // columns: right, down = forward x right, forward
  return [s, c * sp, c * cp, eye[0], -c, s * sp, s * cp, eye[1], 0, -cp, sp, eye[2], 0, 0, 0, 1];
}

/**
 * Return WebGL's projection matrix of a pinhole camera.
 * @param {Pinhole} c
 * @returns {number[]} row-major [16]
 */
export function projection(c) {
  const depth = FAR_M - NEAR_M;
  return [
    (2 * c.fx) / c.width, 0, 1 - (2 * c.cx + 1) / c.width, 0,
    0, (2 * c.fy) / c.height, (2 * c.cy + 1) / c.height - 1, 0,
    0, 0, -(FAR_M + NEAR_M) / depth, (-2 * FAR_M * NEAR_M) / depth,
    0, 0, -1, 0,
  ];
}

/**
 * Return the pixel of a point, or null if it is not in front of the camera.
 * @param {Pinhole} c @param {ArrayLike<number>} point map frame, m
 * @returns {[number, number] | null} u, v in px
 */
export function project(c, point) {
  const [x, y, z] = transform(inverse(c.T_map_camera), point);
  return z > NEAR_M ? [(c.fx * x) / z + c.cx, (c.fy * y) / z + c.cy] : null;
}

/**
 * Return the unit direction (map frame) of the ray through a pixel.
 * @param {Pinhole} c @param {number} u @param {number} v px
 * @returns {Point}
 */
export function ray(c, u, v) {
  const x = (u - c.cx) / c.fx, y = (v - c.cy) / c.fy, n = 1 / Math.hypot(x, y, 1), T = c.T_map_camera;
  return [n * (T[0] * x + T[1] * y + T[2]), n * (T[4] * x + T[5] * y + T[6]), n * (T[8] * x + T[9] * y + T[10])];
}

/**
 * Return a camera with its image fitted into a window of another size: centred, with the largest scale that shows all of it.
 * @param {Pinhole} c @param {number} width @param {number} height px
 * @returns {{camera: Pinhole, left: number, top: number, scale: number}} the camera of the window; where the image is in it
 */
export function fitted(c, width, height) {
  const scale = Math.min(width / c.width, height / c.height);
  const left = (width - scale * c.width) / 2, top = (height - scale * c.height) / 2;
  const camera = {
    ...c, width, height, fx: c.fx * scale, fy: c.fy * scale,
    cx: (c.cx + 0.5) * scale - 0.5 + left, cy: (c.cy + 0.5) * scale - 0.5 + top,
  };
  return { camera, left, top, scale };
}

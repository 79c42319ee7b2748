// The surface under the pointer, for measuring: where a ray becomes opaque.
import { WORDS } from "./codec.js";
import { NEAR_M } from "./pinhole.js";

/** @typedef {import("./pinhole.js").Point} Point */

const REACH = 3.4; // standard deviations at which alpha is below 1/255
const ALPHA_MIN = 1 / 255;
const MIN_VARIANCE = 1e-8; // (0.1 mm)^2: keeps covariances of flat Gaussians invertible
const LEAST_ABSORBED = 0.2; // of a ray that meets a surface: between the Gaussians of a thin wall it is not all

/**
 * Return the point where half of what the ray loses is lost (its median depth), or null if it meets next to nothing.
 * @param {Float32Array} records [>= count * WORDS] @param {number} count
 * @param {ArrayLike<number>} eye m @param {ArrayLike<number>} direction unit vector
 * @param {[number, number]} heights as in `DepthSorter.sort`
 * @returns {Point | null} map frame, m
 */
export function pick(records, count, eye, direction, [low, high]) {
  const [dx, dy, dz] = [direction[0], direction[1], direction[2]];
  const words = new Uint32Array(records.buffer, records.byteOffset, records.length);
  /** @type {{t: number, alpha: number}[]} */
  const hits = [];
  for (let i = 0, at = 0; i < count; i++, at += WORDS) {
    const z = records[at + 2];
    if (z < low || z > high) continue;
    const x = records[at] - eye[0], y = records[at + 1] - eye[1], h = z - eye[2];
    const along = x * dx + y * dy + h * dz, reach = REACH * records[at + 10];
    if (along < NEAR_M || x * x + y * y + h * h - along * along > reach * reach) continue;
    const hit = closest(records, at, x, y, h, dx, dy, dz, (words[at + 3] >>> 24) / 255);
    if (hit.alpha > ALPHA_MIN && hit.t > NEAR_M) hits.push(hit);
  }
  hits.sort((a, b) => a.t - b.t);
  const absorbed = 1 - hits.reduce((rest, { alpha }) => rest * (1 - alpha), 1);
  if (absorbed < LEAST_ABSORBED) return null;
  let left = 1;
  for (const { t, alpha } of hits) {
    left *= 1 - alpha;
    if (1 - left >= absorbed / 2) return [eye[0] + t * dx, eye[1] + t * dy, eye[2] + t * dz];
  }
  return null;
}

/**
 * Return where along the ray a Gaussian is densest, and its alpha there.
 * With S the covariance and m the mean relative to the eye: t = (d^T S^-1 m) / (d^T S^-1 d).
 * @param {Float32Array} r @param {number} at start of the record
 * @param {number} x @param {number} y @param {number} z mean relative to the eye, m
 * @param {number} dx @param {number} dy @param {number} dz unit direction
 * @param {number} opacity
 */
function closest(r, at, x, y, z, dx, dy, dz, opacity) {
  const a = r[at + 4] + MIN_VARIANCE, b = r[at + 5], c = r[at + 6];
  const d = r[at + 7] + MIN_VARIANCE, e = r[at + 8], f = r[at + 9] + MIN_VARIANCE;
  const i00 = d * f - e * e, i01 = c * e - b * f, i02 = b * e - c * d;
  const i11 = a * f - c * c, i12 = b * c - a * e, i22 = a * d - b * b;
  const scale = 1 / (a * i00 + b * i01 + c * i02);
  const qx = i00 * dx + i01 * dy + i02 * dz, qy = i01 * dx + i11 * dy + i12 * dz, qz = i02 * dx + i12 * dy + i22 * dz;
  const t = (qx * x + qy * y + qz * z) / (qx * dx + qy * dy + qz * dz);
  const mx = x - t * dx, my = y - t * dy, mz = z - t * dz;
  const square = scale * (i00 * mx * mx + i11 * my * my + i22 * mz * mz + 2 * (i01 * mx * my + i02 * mx * mz + i12 * my * mz));
  return { t, alpha: opacity * Math.exp(-0.5 * Math.max(square, 0)) };
}

/**
 * Return what is measured between two points of the map, in m.
 * @param {Point} a @param {Point} b
 */
export function measure(a, b) {
  return {
    distance: Math.hypot(b[0] - a[0], b[1] - a[1], b[2] - a[2]),
    horizontal: Math.hypot(b[0] - a[0], b[1] - a[1]),
    height: b[2] - a[2],
  };
}

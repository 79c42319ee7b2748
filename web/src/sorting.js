// Culling of Gaussians against the view, and their order from far to near for blending.
import { WORDS } from "./codec.js";
import { NEAR_M, inverse } from "./pinhole.js";

/** @typedef {import("./pinhole.js").Pinhole} Pinhole */

const BUCKETS = 65536; // of depth: 0.5 mm each over 30 m
const REACH = 3.4; // standard deviations at which alpha is below 1/255, as in common/raster/culling.py
const BLUR_REACH_PX = 1 + REACH * Math.sqrt(0.3); // of the low-pass of the projection

/** Counting sort by depth; its arrays are reused. */
export class DepthSorter {
  constructor() {
    this.order = new Uint32Array(0); // Gaussians that may be visible, farthest first
    this.visible = 0; // how many of `order` are valid
    this._index = new Uint32Array(0);
    this._depth = new Float32Array(0);
    this._start = new Uint32Array(BUCKETS);
  }

  /**
   * Fill `order` and `visible`.
   * @param {Float32Array} records [>= count * WORDS]
   * @param {number} count
   * @param {Pinhole} camera
   * @param {[number, number]} heights only Gaussians with low <= z <= high (m, map frame) are kept
   */
  sort(records, count, camera, heights) {
    if (this.order.length < count) {
      this.order = new Uint32Array(count + (count >> 2));
      this._index = new Uint32Array(this.order.length);
      this._depth = new Float32Array(this.order.length);
    }
    const [near, far] = this._cull(records, count, camera, heights);
    const start = this._start.fill(0), n = this.visible, depth = this._depth, index = this._index, order = this.order;
    const scale = (BUCKETS - 1) / Math.max(far - near, 1e-6);
    for (let i = 0; i < n; i++) start[((far - depth[i]) * scale) | 0]++;
    for (let b = 0, sum = 0; b < BUCKETS; b++) { const k = start[b]; start[b] = sum; sum += k; }
    for (let i = 0; i < n; i++) order[start[((far - depth[i]) * scale) | 0]++] = index[i];
  }

  /**
   * List the Gaussians that may be visible, with their depths; the bound is that of common/raster/culling.py.
   * @param {Float32Array} records @param {number} count @param {Pinhole} c @param {[number, number]} heights
   * @returns {[number, number]} smallest and largest depth, m
   */
  _cull(records, count, c, [low, high]) {
    const T = inverse(c.T_map_camera), index = this._index, depth = this._depth;
    const steepX = Math.max(c.cx + 0.5, c.width - 0.5 - c.cx) / c.fx + (0.15 * c.width) / c.fx;
    const steepY = Math.max(c.cy + 0.5, c.height - 0.5 - c.cy) / c.fy + (0.15 * c.height) / c.fy;
    const reach = REACH * Math.max(c.fx, c.fy) * Math.sqrt(1 + Math.max(steepX, steepY) ** 2);
    let n = 0, near = Infinity, far = -Infinity;
    for (let i = 0, at = 0; i < count; i++, at += WORDS) {
      const x = records[at], y = records[at + 1], z = records[at + 2];
      const zc = T[8] * x + T[9] * y + T[10] * z + T[11];
      if (!(zc > NEAR_M) || z < low || z > high) continue;
      const pad = (reach * records[at + 10]) / zc + BLUR_REACH_PX;
      const u = (c.fx * (T[0] * x + T[1] * y + T[2] * z + T[3])) / zc + c.cx;
      if (u + pad < 0 || u - pad > c.width) continue;
      const v = (c.fy * (T[4] * x + T[5] * y + T[6] * z + T[7])) / zc + c.cy;
      if (v + pad < 0 || v - pad > c.height) continue;
      index[n] = i;
      depth[n++] = zc;
      if (zc < near) near = zc;
      if (zc > far) far = zc;
    }
    this.visible = n;
    return [near, Math.fround(far)];
  }
}

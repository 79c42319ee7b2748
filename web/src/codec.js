// Decoder of packed Gaussians: the bytes of `pack` in common/messages/splat_codec.py ("SPL1").
// A placed Gaussian is a record of 12 words of 32 bits, three texels of the data texture:
//   x y z (float, m, map frame) rgba (bytes) | Sxx Sxy Sxz Syy (float, m^2) | Syz Szz, largest standard deviation (m), 0

export const WORDS = 12;
const HEAD_BYTES = 32; // "SPL1", count uint32, corners of the means 6 x float32
const PLANES = 17; // bytes per Gaussian: mean high 3, low 3, scale 3, quaternion 4, opacity 1, colour 3
const MAX_GAUSSIANS = 8_000_000; // as in splat_codec.py
const LOG_SCALE = [-9.2, 2.9]; // range of ln(scale in m), as in splat_codec.py
const SIGMA_M = Float64Array.from({ length: 256 }, (_, b) => Math.exp(LOG_SCALE[0] + (b / 255) * (LOG_SCALE[1] - LOG_SCALE[0])));

/**
 * Gaussians of a chunk in the anchor's frame, still quantised.
 * @typedef {{count: number, low: Float32Array, high: Float32Array, planes: Uint8Array}} PackedGaussians
 */

/**
 * Decompress packed Gaussians.
 * @param {Uint8Array} bytes
 * @returns {Promise<PackedGaussians>}
 * @throws {Error} the bytes are not packed Gaussians, or truncated
 */
export async function decode(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < HEAD_BYTES || view.getUint32(0, true) !== 0x314c5053) throw new Error("a chunk of the map is no packed Gaussians (no SPL1)");
  const count = view.getUint32(4, true);
  const corners = Float32Array.from({ length: 6 }, (_, i) => view.getFloat32(8 + 4 * i, true));
  if (count > MAX_GAUSSIANS || !corners.every(Number.isFinite)) throw new Error(`a chunk of the map is damaged: ${count} Gaussians`);
  const planes = await inflate(bytes.subarray(HEAD_BYTES));
  if (planes.length !== PLANES * count) throw new Error(`a chunk of the map is truncated: ${planes.length} bytes for ${count} Gaussians`);
  return { count, low: corners.subarray(0, 3), high: corners.subarray(3), planes };
}

/** @param {Uint8Array} bytes zlib @returns {Promise<Uint8Array>} */
async function inflate(bytes) {
  const whole = new Blob([/** @type {Uint8Array<ArrayBuffer>} */ (bytes)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(whole).arrayBuffer());
}

/**
 * Return the records of a chunk's Gaussians in the map frame.
 * @param {PackedGaussians} chunk
 * @param {ArrayLike<number>} T_map_anchor row-major [16]
 * @returns {Uint32Array} [count * WORDS]
 */
export function place(chunk, T_map_anchor) {
  const { count: n, planes, low, high } = chunk, T = T_map_anchor;
  const words = new Uint32Array(n * WORDS), floats = new Float32Array(words.buffer);
  const signed = new Int8Array(planes.buffer, planes.byteOffset, planes.length);
  const step = [0, 1, 2].map((k) => Math.max(high[k] - low[k], 1e-9) / 65535);
  const M = new Float64Array(9);
  for (let i = 0, at = 0; i < n; i++, at += WORDS) {
    const x = low[0] + step[0] * (planes[i] * 256 + planes[3 * n + i]);
    const y = low[1] + step[1] * (planes[n + i] * 256 + planes[4 * n + i]);
    const z = low[2] + step[2] * (planes[2 * n + i] * 256 + planes[5 * n + i]);
    floats[at] = T[0] * x + T[1] * y + T[2] * z + T[3];
    floats[at + 1] = T[4] * x + T[5] * y + T[6] * z + T[7];
    floats[at + 2] = T[8] * x + T[9] * y + T[10] * z + T[11];
    words[at + 3] = (planes[14 * n + i] | (planes[15 * n + i] << 8) | (planes[16 * n + i] << 16) | (planes[13 * n + i] << 24)) >>> 0;
    const s0 = SIGMA_M[planes[6 * n + i]], s1 = SIGMA_M[planes[7 * n + i]], s2 = SIGMA_M[planes[8 * n + i]];
    axes(T, signed[9 * n + i], signed[10 * n + i], signed[11 * n + i], signed[12 * n + i], s0, s1, s2, M);
    floats[at + 4] = M[0] * M[0] + M[1] * M[1] + M[2] * M[2];
    floats[at + 5] = M[0] * M[3] + M[1] * M[4] + M[2] * M[5];
    floats[at + 6] = M[0] * M[6] + M[1] * M[7] + M[2] * M[8];
    floats[at + 7] = M[3] * M[3] + M[4] * M[4] + M[5] * M[5];
    floats[at + 8] = M[3] * M[6] + M[4] * M[7] + M[5] * M[8];
    floats[at + 9] = M[6] * M[6] + M[7] * M[7] + M[8] * M[8];
    floats[at + 10] = Math.max(s0, s1, s2);
  }
  return words;
}

/**
 * Write M = R_map_anchor R(quat) diag(s) to `M`, row-major [9]; the covariance is M M^T.
 * @param {ArrayLike<number>} T row-major [16]
 * @param {number} qw @param {number} qx @param {number} qy @param {number} qz of any norm
 * @param {number} s0 @param {number} s1 @param {number} s2 standard deviations, m
 * @param {Float64Array} M
 */
function axes(T, qw, qx, qy, qz, s0, s1, s2, M) {
  const norm = 1 / Math.max(Math.hypot(qw, qx, qy, qz), 1e-6);
  const w = qw * norm, x = qx * norm, y = qy * norm, z = qz * norm;
  const r00 = (1 - 2 * (y * y + z * z)) * s0, r01 = 2 * (x * y - w * z) * s1, r02 = 2 * (x * z + w * y) * s2;
  const r10 = 2 * (x * y + w * z) * s0, r11 = (1 - 2 * (x * x + z * z)) * s1, r12 = 2 * (y * z - w * x) * s2;
  const r20 = 2 * (x * z - w * y) * s0, r21 = 2 * (y * z + w * x) * s1, r22 = (1 - 2 * (x * x + y * y)) * s2;
  for (let row = 0; row < 3; row++) {
    const a = T[4 * row], b = T[4 * row + 1], c = T[4 * row + 2];
    M[3 * row] = a * r00 + b * r10 + c * r20;
    M[3 * row + 1] = a * r01 + b * r11 + c * r21;
    M[3 * row + 2] = a * r02 + b * r12 + c * r22;
  }
}

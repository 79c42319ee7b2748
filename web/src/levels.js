// Choice of the level of detail of each chunk: by distance, within a budget of Gaussians.
import { distance, inverse, transform } from "./pinhole.js";

/**
 * @typedef {{cell_m: number, count: number, bytes: number}} Level
 * @typedef {{anchor: number, revision: number, T_map_anchor: number[], low: number[], high: number[], levels: Level[]}} Chunk
 */

const ERROR_PX = 1; // cells of the merged Gaussians may appear so large where the budget permits it
const GROWTH = 1.4; // of the permitted error, until the Gaussians fit the budget
const MAX_ERROR_PX = 1e4;

/**
 * Return the distance (m) from a point to the box of a chunk; 0 inside.
 * @param {Chunk} chunk @param {ArrayLike<number>} eye map frame, m
 */
export function distanceToBox(chunk, eye) {
  const p = transform(inverse(chunk.T_map_anchor), eye);
  return Math.hypot(...p.map((v, k) => Math.max(chunk.low[k] - v, 0, v - chunk.high[k])));
}

/**
 * Return the level of each chunk for a viewpoint. Where even the coarsest levels exceed the budget, the farthest
 * chunks have none.
 * @param {Chunk[]} chunks @param {ArrayLike<number>} eye map frame, m
 * @param {number} focalPx @param {number} budget number of Gaussians
 * @returns {Map<number, Level>} by anchor, nearest first
 */
export function chooseLevels(chunks, eye, focalPx, budget) {
  const near = chunks
    .filter((c) => c.levels.length)
    .map((chunk) => ({ chunk, away: distanceToBox(chunk, eye) }))
    .sort((a, b) => a.away - b.away);
  for (let error = ERROR_PX; ; error *= GROWTH) {
    const chosen = new Map(near.map(({ chunk, away }) => [chunk.anchor, levelAt(chunk.levels, (error * away) / focalPx)]));
    let total = 0;
    for (const level of chosen.values()) total += level.count;
    if (total <= budget) return chosen;
    if (error < MAX_ERROR_PX) continue;
    // A viewer inside a large chunk sees it at its coarsest level rather than not at all.
    total = 0;
    const kept = near.map(({ chunk }) => /** @type {[number, Level]} */ ([chunk.anchor, chunk.levels[chunk.levels.length - 1]]));
    return new Map(kept.filter(([, level], i) => (total += level.count) <= budget || i === 0));
  }
}

/** @param {Level[]} levels finest first @param {number} cell_m largest permitted cell */
function levelAt(levels, cell_m) {
  return levels.findLast((level) => level.cell_m <= cell_m) ?? levels[0];
}

/**
 * Return the middle and the diameter (m) of a map from the boxes of its chunks, null without chunks.
 * @param {Chunk[]} chunks
 * @returns {{middle: import("./pinhole.js").Point, size: number} | null}
 */
export function extentOf(chunks) {
  if (!chunks.length) return null;
  const centres = chunks.map((c) => transform(c.T_map_anchor, c.low.map((v, k) => (v + c.high[k]) / 2)));
  const middle = /** @type {import("./pinhole.js").Point} */ ([0, 1, 2].map((k) => centres.reduce((sum, p) => sum + p[k], 0) / centres.length));
  const radii = chunks.map((c) => Math.hypot(...c.high.map((v, k) => v - c.low[k])) / 2);
  return { middle, size: 2 * Math.max(...centres.map((p, i) => distance(p, middle) + radii[i])) };
}

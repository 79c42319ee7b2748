// Measuring: points that were picked, and what is said about them.
import { measure } from "./picking.js";

/** @typedef {import("./pinhole.js").Point} Point */

const HINT = "Measure: click a point of the map, then a second one (or press Enter for the middle of the picture)";

/** @param {number} v m */
const metres = (v) => `${v.toFixed(3)} m`;

export class Measuring {
  constructor() {
    this.on = false;
    /** @type {Point[]} */
    this.points = []; // none, one or two
  }

  /** Start or end; returns what to say. @param {boolean} on @returns {string} */
  set(on) {
    this.on = on;
    this.points = [];
    return on ? HINT : "";
  }

  /**
   * Add a picked point; a third one starts anew. Returns what to say.
   * @param {Point | null} point map frame, m; null: there is no surface
   * @returns {string}
   */
  add(point) {
    if (!point) return "No surface there: click on a part of the map";
    this.points = this.points.length === 1 ? [this.points[0], point] : [point];
    const [first, second] = this.points;
    if (!second) return `Height above the floor: ${metres(first[2])}`;
    const m = measure(first, second);
    return `Distance ${metres(m.distance)} (horizontal ${metres(m.horizontal)}, height difference ${metres(m.height)})`;
  }
}

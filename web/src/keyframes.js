// The keyframes of the map: which one is meant, their thumbnails.
import { h } from "./dom.js";
import { distance, forward, origin, project } from "./pinhole.js";

/** @typedef {import("./pinhole.js").Pinhole} Pinhole */
/** @typedef {import("./pinhole.js").Point} Point */
/** @typedef {import("./feed.js").Keyframe} Keyframe */

const HOVER_PX = 14; // from a keyframe to the pointer
const THUMB_PX = 160;

export class Keyframes {
  constructor() {
    /** @type {Keyframe[]} */
    this.list = [];
    /** @type {import("./feed.js").MapIndex["camera"]} */
    this.camera = null; // of all keyframes; null: not known, then none can be drawn or compared
    /** @type {Keyframe | null} */
    this.compared = null;
    this._image = h("img", { alt: "" });
    this._text = h("figcaption", {});
    this.thumbnail = h("figure", { className: "v3-thumb", hidden: true }, this._image, this._text);
  }

  /** @param {import("./feed.js").MapIndex} index */
  update(index) {
    this.list = index.keyframes;
    this.camera = index.camera;
  }

  /** Return the camera of a keyframe. @param {Keyframe} keyframe @returns {Pinhole | null} */
  pinhole({ T_map_camera }) {
    const c = this.camera;
    return c && { T_map_camera, fx: c.K[0], fy: c.K[4], cx: c.K[2], cy: c.K[5], width: c.width, height: c.height };
  }

  /**
   * Return the index of the keyframe drawn at a pixel, null = none.
   * @param {Pinhole} camera @param {number} u @param {number} v px @param {number} ratio px of the camera per CSS px
   * @returns {number | null}
   */
  at(camera, u, v, ratio) {
    if (!this.camera || this.compared) return null;
    let best = null, least = HOVER_PX * ratio;
    for (let i = 0; i < this.list.length; i++) {
      const px = project(camera, origin(this.list[i].T_map_camera));
      const gap = px ? Math.hypot(px[0] - u, px[1] - v) : Infinity;
      if (gap < least) { best = i; least = gap; }
    }
    return best;
  }

  /**
   * Return the index of the keyframe whose view is most like a given one; -1 without keyframes.
   * @param {Point} eye m @param {Point} view unit vector
   */
  nearest(eye, view) {
    if (!this.camera || !this.list.length) return -1;
    const costs = this.list.map(({ T_map_camera: T }) => {
      const f = forward(T), cos = f[0] * view[0] + f[1] * view[1] + f[2] * view[2];
      return distance(eye, origin(T)) + Math.acos(Math.max(-1, Math.min(1, cos))); // a metre counts as much as a radian
    });
    return costs.reduce((best, cost, i) => (cost < costs[best] ? i : best), 0);
  }

  /**
   * Show the thumbnail of a keyframe at a place, or none.
   * @param {number | null} index @param {(id: string, width: number) => string} url "" = there is none
   * @param {number} left @param {number} top CSS px in the viewer
   */
  hover(index, url, left, top) {
    this.thumbnail.hidden = index === null;
    if (index === null) return;
    const { id } = this.list[index], source = url(id, THUMB_PX);
    if (source && this._image.getAttribute("src") !== source) this._image.src = source;
    this._image.hidden = !source;
    this._text.textContent = `keyframe ${index + 1}: click to compare`;
    Object.assign(this.thumbnail.style, { left: `${Math.max(left, 0)}px`, top: `${Math.max(top, 0)}px` });
  }
}

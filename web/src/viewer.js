// The 3D map in a browser: `openViewer(element, {base, saved, embedded})`. See docs/howto/view3d.md.
import { Scene3D } from "./scene.js";
import { controlActions, panelActions } from "./actions.js";
import { EmbeddedFeed, LiveFeed } from "./feed.js";
import { ChunkStore } from "./chunks.js";
import { Comparison } from "./compare.js";
import { attachControls } from "./controls.js";
import { adoptStyles, h, saveAs } from "./dom.js";
import { Navigation } from "./navigation.js";
import { Panel } from "./panel.js";
import { Keyframes } from "./keyframes.js";
import { extentOf } from "./levels.js";
import { Measuring } from "./measuring.js";
import { pick } from "./picking.js";
import { distance, fitted, focalPx, forward, origin, ray } from "./pinhole.js";
import css from "./style.css";

/** @typedef {import("./pinhole.js").Pinhole} Pinhole */
/** @typedef {import("./pinhole.js").Point} Point */

const BUDGET = { desk: 300_000, phone: 100_000 }; // Gaussians
const PITCH_RAD = -0.75; // of the view of the whole map
const MOVED_M = 0.3; // of the viewpoint, after which the levels of detail are chosen again
const ASSEMBLE_MS = 200; // between two uploads of changed Gaussians

/**
 * Show a map in an element.
 * @param {HTMLElement} element that the viewer fills
 * @param {{base: string, saved: boolean, embedded?: import("./feed.js").MapIndex | null}} options
 *   base: prefix of the routes, "" = relative to the document; saved: the map does not change; embedded: the whole map
 * @returns {Viewer}
 * @throws {Error} the browser has no WebGL 2
 */
export function openViewer(element, options) {
  const viewer = new Viewer(element, options);
  /** @type {any} */ (element).viewer = viewer;
  return viewer;
}

export class Viewer {
  /** @param {HTMLElement} element @param {{base: string, saved: boolean, embedded?: import("./feed.js").MapIndex | null}} options */
  constructor(element, { base, saved, embedded = null }) {
    this.canvas = h("canvas", { className: "v3-canvas", tabIndex: 0, role: "application", "aria-label": "3D map: arrow keys turn the view, plus and minus zoom; more keys are listed in Options" });
    this.scene = new Scene3D(this.canvas, { step: (seconds) => this.navigation.step(seconds), prepare: () => this._prepare() });
    const phone = matchMedia("(pointer: coarse)").matches;
    this.budget = phone ? BUDGET.phone : BUDGET.desk;
    this.navigation = new Navigation(matchMedia("(prefers-reduced-motion: reduce)").matches);
    this.panel = new Panel(panelActions(this), this.budget);
    this.keyframes = new Keyframes();
    this.measuring = new Measuring();
    this.framed = false; // the view was set to show the whole map, or by the user
    this._assembledAt = -Infinity;
    this._dirty = false;
    this._note = ""; // of the server: why the map is not complete
    /** @type {Point} */
    this._chosenAt = [NaN, NaN, NaN];
    const events = this._feedEvents();
    this.feed = embedded ? new EmbeddedFeed(embedded, events) : new LiveFeed(base, saved, events);
    this.store = new ChunkStore(this.feed, () => { this._dirty = true; this.scene.invalidate(); }, (text) => this.panel.say(text));
    this.comparison = new Comparison(() => this.endComparison(), this.feed.canRender);
    this.element = element;
    adoptStyles(css);
    element.classList.add("viewer3d");
    element.replaceChildren(this.panel.bar, this.canvas, this.panel.text, this.keyframes.thumbnail, this.comparison.element);
    attachControls(this.canvas, this.navigation, controlActions(this));
    this._resize = new ResizeObserver(() => this.scene.invalidate());
    this._resize.observe(this.canvas);
  }

  /** What is shown, for scripts and tests. */
  get state() {
    return {
      gaussians: this.scene.splats.count, drawn: this.scene.splats.sorter.visible, chunks: this.store.shown.size,
      complete: this.store.complete && !this._dirty, mode: this.navigation.mode, eye: [...this.navigation.eye], robot: this.navigation.robot,
      revisions: Object.fromEntries([...this.store.shown].map(([anchor, s]) => [anchor, s.revision])),
      frameMs: this.scene.frameMs, resting: this.scene.resting, keyframes: this.keyframes.list.length, compared: this.keyframes.compared?.id ?? null,
    };
  }

  /**
   * Return the Gaussians as a PNG, seen by a camera; without it as on the screen, with all layers.
   * @param {Pinhole} [camera]
   * @returns {Promise<Blob>}
   */
  picture(camera) { return this.scene.picture(camera ?? this._camera(), camera === undefined); }

  /** Move to a pose. @param {number[]} T_map_camera row-major [16]; its roll is not kept */
  look(T_map_camera) {
    this.framed = true;
    const f = forward(T_map_camera);
    this.navigation.goTo({ eye: origin(T_map_camera), yaw: Math.atan2(f[1], f[0]), pitch: Math.asin(Math.max(-1, Math.min(1, f[2]))) });
    this.scene.invalidate();
  }

  /** Compare the render with a keyframe. @param {number} index */
  compare(index) {
    const keyframe = this.keyframes.list[index], pinhole = keyframe && this.keyframes.pinhole(keyframe);
    if (!pinhole) return;
    this.look(keyframe.T_map_camera);
    this.keyframes.compared = keyframe;
    this.panel.setKeyframe(index);
    this.comparison.open(`3D view | keyframe ${index + 1}`, { camera: this.feed.keyframeURL(keyframe.id), render: this.feed.renderURL(pinhole) });
    this._drawKeyframes();
    this.scene.invalidate();
  }

  endComparison() {
    if (!this.keyframes.compared) return;
    this.keyframes.compared = null;
    this.comparison.close();
    this._drawKeyframes();
    this.scene.invalidate();
  }

  close() {
    this.feed.close();
    this.store.close();
    this._resize.disconnect();
    this.scene.dispose();
    this.element.replaceChildren();
    delete /** @type {any} */ (this.element).viewer;
    this.element.classList.remove("viewer3d", "measuring");
  }

  /** Prepare a frame. */
  _prepare() {
    const now = performance.now();
    if (this._dirty && now - this._assembledAt >= ASSEMBLE_MS) this._assemble(now);
    if (!(distance(this._eye, this._chosenAt) < MOVED_M)) this.choose();
    const camera = this._camera(), pinhole = this._comparedPinhole();
    if (pinhole) {
      const { left, top, scale } = fitted(pinhole, this.canvas.clientWidth, this.canvas.clientHeight);
      this.comparison.place(left, this.canvas.offsetTop + top, scale * pinhole.width, scale * pinhole.height);
    }
    this._facts();
    return { camera, again: this.navigation.moving || this._dirty };
  }

  /** The camera of the canvas. @returns {Pinhole} */
  _camera() {
    const { width, height } = this.scene.size;
    const pinhole = this._comparedPinhole();
    if (pinhole) return fitted(pinhole, width, height).camera;
    const focal = focalPx(height);
    return { T_map_camera: this.navigation.pose, fx: focal, fy: focal, cx: width / 2 - 0.5, cy: height / 2 - 0.5, width, height };
  }

  /** The camera of the keyframe that is compared. @returns {Pinhole | null} */
  _comparedPinhole() { return this.keyframes.compared && this.keyframes.pinhole(this.keyframes.compared); }
  /** Where the map is seen from. @returns {Point} */
  get _eye() { return this.keyframes.compared ? origin(this.keyframes.compared.T_map_camera) : this.navigation.eye; }

  /** @param {number} now ms */
  _assemble(now) {
    this._assembledAt = now;
    this._dirty = false;
    this.scene.setGaussians(this.store.assemble());
    const bounds = this.scene.bounds();
    if (!bounds) return;
    this.panel.setHeights(bounds.low[2], bounds.high[2]);
    if (!this.framed && this.store.complete) this.whole(true);
  }

  choose() {
    const [x, y, z] = this._eye;
    this._chosenAt = [x, y, z];
    if (this.store.index.size) this.store.choose(this._eye, this._camera().fx, this.budget);
  }

  /** From where a map with this diagonal (m) fills the picture. @param {number} size */
  _distanceOf(size) { return Math.max(size / Math.min(1, this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1)), 1); }

  /** Show the whole map. @param {boolean} [atOnce] */
  whole(atOnce = false) {
    const bounds = this.scene.bounds();
    if (!bounds) return;
    this.endComparison();
    const { low, high } = bounds, size = Math.hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]);
    this.framed = true;
    if (this.navigation.mode !== "fly") this.setMode("orbit");
    this.navigation.goTo({ pivot: [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, (low[2] + high[2]) / 2], distance: this._distanceOf(size), pitch: PITCH_RAD }, atOnce);
    this.scene.invalidate();
  }

  /** The user moved the view. */
  moved() {
    this.framed = true;
    this.endComparison();
    this.scene.invalidate();
  }

  /** @param {import("./navigation.js").Mode} mode */
  setMode(mode) {
    if ((mode === "follow" || mode === "first") && !this.navigation.robot) return;
    this.endComparison();
    if (mode !== "orbit") this.framed = true;
    this.navigation.setMode(mode);
    this.scene.invalidate();
  }

  _facts() {
    this.panel.setMode(this.navigation.mode); // flying ends some
    const { count, sorter } = this.scene.splats, loading = this.store.complete ? "" : ", loading";
    const text = count ? `${count.toLocaleString("en")} Gaussians, ${sorter.visible.toLocaleString("en")} in view${loading}` : `No Gaussians yet${loading}`;
    this.panel.note(this._note);
    if (this.panel.facts.textContent !== text) this.panel.facts.textContent = text;
  }

  /** @returns {import("./feed.js").FeedEvents} */
  _feedEvents() {
    return {
      index: (index) => this._index(index),
      robot: (robot) => {
        this.navigation.robot = robot && { x: robot.x_m, y: robot.y_m, z: 0, yaw: robot.yaw_rad };
        this.scene.overlays.setRobot(this.navigation.robot);
        this.panel.setRobot(this.navigation.robot !== null);
        this.scene.invalidate();
      },
      path: (cm) => { this.scene.overlays.setPath(cm); this.scene.invalidate(); },
      scan: (scan) => { this.scene.overlays.setScan(scan); this.scene.invalidate(); },
      plan: (image, place) => { this.scene.overlays.setPlan(image, place); this.scene.invalidate(); },
      connection: (text) => this.panel.say(text),
    };
  }

  /** @param {import("./feed.js").MapIndex} index */
  _index(index) {
    this.store.update(index);
    this._note = index.note || (index.limited?.left_out ? `${index.limited.left_out} parts of the map are left out: see the option map3d_mb of the page` : "");
    this.keyframes.update(index);
    const last = index.keyframes.at(-1);
    if (last) {
      this.navigation.eyeHeight = Math.max(last.T_map_camera[11], 0.05);
      this.navigation.eyePitch = Math.asin(Math.max(-1, Math.min(1, last.T_map_camera[10])));
    }
    const extent = this.framed ? null : extentOf(index.chunks); // roughly as `whole` will, for the right levels of detail
    if (extent) this.navigation.goTo({ pivot: extent.middle, distance: this._distanceOf(extent.size), pitch: PITCH_RAD }, true);
    this.panel.setKeyframes(index.camera ? index.keyframes.length : 0);
    this._drawKeyframes();
    this.choose();
    this.scene.invalidate();
  }

  _drawKeyframes() {
    const { list, camera, compared } = this.keyframes;
    if (camera) this.scene.overlays.setKeyframes(compared ? [] : list, camera); // they would hide the picture
  }

  /** @param {number} x @param {number} y CSS px */
  click(x, y) {
    if (this.measuring.on) { this.measureAt(x, y); return; }
    const index = this._keyframeAt(x, y);
    if (index !== null) this.compare(index);
  }

  /** @param {boolean} on */
  setMeasuring(on) {
    if (on === this.measuring.on) return;
    this.panel.say(this.measuring.set(on));
    this.panel.setMeasuring(on);
    this.element.classList.toggle("measuring", on);
    this.scene.overlays.setMeasure([]);
    this.scene.invalidate();
  }

  /** @param {number} x @param {number} y CSS px */
  measureAt(x, y) {
    if (!this.measuring.on) return;
    const { camera, u, v } = this._pixel(x, y), { splats } = this.scene;
    this.panel.say(this.measuring.add(pick(splats.records, splats.count, origin(camera.T_map_camera), ray(camera, u, v), splats.heights)));
    this.scene.overlays.setMeasure(this.measuring.points);
    this.scene.invalidate();
  }

  /** Return the camera, and the pixel at a place of the canvas. @param {number} x @param {number} y CSS px */
  _pixel(x, y) {
    const camera = this._camera(), ratio = camera.width / this.canvas.clientWidth;
    return { camera, ratio, u: x * ratio - 0.5, v: y * ratio - 0.5 };
  }

  /** @param {number} x @param {number} y CSS px @returns {number | null} index */
  _keyframeAt(x, y) {
    if (!this.scene.isShown("keyframes")) return null;
    const { camera, ratio, u, v } = this._pixel(x, y);
    return this.keyframes.at(camera, u, v, ratio);
  }

  /** @param {number} x @param {number} y CSS px, NaN = the pointer left */
  hover(x, y) {
    const index = Number.isNaN(x) || this.measuring.on ? null : this._keyframeAt(x, y);
    const left = Math.min(x + 12, this.canvas.clientWidth - 180), top = Math.min(y + 12, this.canvas.clientHeight - 150);
    this.keyframes.hover(index, (id, width) => this.feed.keyframeURL(id, width), left, this.canvas.offsetTop + top);
  }

  compareNearest() { this.compare(this.keyframes.nearest(this._eye, this.navigation.forward)); }
  async save() { saveAs(await this.picture(), `beamsplat-${new Date().toISOString().slice(0, 19).replaceAll(":", "-")}.png`); }
}

// For documents that have this module inside, which cannot be imported by a name.
/** @type {any} */ (globalThis).beamsplatViewer = { openViewer };

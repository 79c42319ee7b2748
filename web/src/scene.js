// Drawing: three.js, one frame when something changed, with fewer pixels while the view moves on a slow device.
import { Camera, Color, ColorManagement, LinearSRGBColorSpace, Scene, WebGLRenderer } from "three";
import { WORDS } from "./codec.js";
import { Overlays } from "./overlays.js";
import { projection } from "./pinhole.js";
import { Splats } from "./splats.js";

/** @typedef {import("./pinhole.js").Pinhole} Pinhole */
/**
 * What the viewer does for a frame: `step` moves the viewpoint; `prepare` returns the camera, and whether another frame
 * must follow.
 * @typedef {{step: (seconds: number) => void, prepare: () => {camera: Pinhole, again: boolean}}} FrameActions
 */

const MAX_PIXEL_RATIO = 2; // of the screen: more costs time and is not seen
const SLOW_MS = 40, QUICK_MS = 18; // of a frame in motion: then fewer or more pixels are drawn
const LEAST_SCALE = 0.35;
const STILL_MS = 250; // after the last motion, until a frame with all pixels is drawn
const SAMPLES = 20_000; // Gaussians from which the extent of the map is computed
const OUTLIERS = 0.01; // share of the Gaussians at each end that the extent leaves out
const BACKGROUND = 0x000000; // as of the renders of the mapper

// Colours are plain sRGB values and are blended as such, as in common/raster.
ColorManagement.enabled = false;

export class Scene3D {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {FrameActions} actions
   * @throws {Error} the browser has no WebGL 2
   */
  constructor(canvas, actions) {
    this._canvas = canvas;
    this._actions = actions;
    this._renderer = makeRenderer(canvas);
    this._scene = new Scene();
    this._scene.background = new Color(BACKGROUND);
    this._camera = new Camera();
    this._camera.matrixAutoUpdate = false;
    this.splats = new Splats();
    this.overlays = new Overlays();
    this._scene.add(this.overlays.group, this.splats.mesh);
    this.stale = true; // the order of the Gaussians is outdated
    this.frameMs = 0; // average time from frame to frame in motion
    this._sorted = "";
    this._gaussiansShown = true;
    this._hidden = new Set();
    this._scale = 1; // of the resolution, in motion
    this._last = NaN; // time of the frame before, ms
    this._again = false; // it asked for this frame
    this._movedAt = -Infinity;
    this._pose = "";
    this._request = 0;
    this._timer = 0;
    canvas.addEventListener("webglcontextrestored", () => { this.stale = true; this.invalidate(); });
  }

  /** Size of the drawing buffer, px. */
  get size() {
    const ratio = Math.min(devicePixelRatio || 1, MAX_PIXEL_RATIO) * (this._inMotion() ? this._scale : 1);
    return {
      width: Math.max(Math.round(this._canvas.clientWidth * ratio), 1), height: Math.max(Math.round(this._canvas.clientHeight * ratio), 1),
    };
  }

  /** Whether the newest frame has all pixels, and nothing moves. */
  get resting() { return !this._request && !this._inMotion() && this._canvas.width === this.size.width; }

  /** Draw a frame soon. */
  invalidate() {
    if (!this._request) this._request = requestAnimationFrame((now) => this._frame(now));
  }

  /** @param {Uint32Array} words see codec.js */
  setGaussians(words) {
    this.splats.set(words);
    this.stale = true;
  }

  /** @param {import("./overlays.js").Layer | "gaussians"} layer @param {boolean} visible */
  show(layer, visible) {
    if (visible) this._hidden.delete(layer); else this._hidden.add(layer);
    if (layer === "gaussians") this._gaussiansShown = visible; else this.overlays.show(layer, visible);
  }

  /** @param {import("./overlays.js").Layer} layer */
  isShown(layer) { return !this._hidden.has(layer); }

  /**
   * Return the box that contains the map without its outliers, or null without Gaussians.
   * @returns {{low: number[], high: number[]} | null} m
   */
  bounds() {
    const { records, count } = this.splats;
    if (!count) return null;
    const stride = Math.max(1, Math.floor(count / SAMPLES)), n = Math.ceil(count / stride), out = Math.floor(n * OUTLIERS);
    const axes = [0, 1, 2].map((k) => Float32Array.from({ length: n }, (_, i) => records[i * stride * WORDS + k]).sort());
    return { low: axes.map((a) => a[out]), high: axes.map((a) => a[n - 1 - out]) };
  }

  /**
   * Return a picture as PNG, in the size of its camera.
   * @param {Pinhole} camera @param {boolean} layers with path, robot and so on
   * @returns {Promise<Blob>}
   */
  picture(camera, layers) {
    this._renderer.setSize(camera.width, camera.height, false);
    this.overlays.group.visible = layers;
    this.splats.prepare(camera);
    this._draw(camera);
    this.overlays.group.visible = true;
    this.stale = true;
    this.invalidate();
    return new Promise((resolve, reject) => {
      // The browser reads the pixels before it gives the drawing buffer away.
      this._canvas.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("the browser made no picture"))), "image/png");
    });
  }

  dispose() {
    cancelAnimationFrame(this._request);
    clearTimeout(this._timer);
    this._request = -1; // no more frames
    this.overlays.dispose();
    this.splats.dispose();
    this._renderer.dispose();
  }

  /** @param {number} now ms, of requestAnimationFrame */
  _frame(now) {
    this._request = 0;
    if (!this._canvas.clientWidth) return; // hidden: the observer of its size asks for the next frame
    const gap = now - this._last;
    this._last = now;
    if (this._inMotion()) this._adapt(gap);
    this._actions.step(this._again ? Math.min(gap / 1000, 0.1) : 1 / 60);
    const { camera, again } = this._actions.prepare(), pose = String(camera.T_map_camera), key = JSON.stringify(camera);
    if (pose !== this._pose) this._movedAt = performance.now();
    this._pose = pose;
    this._renderer.setSize(camera.width, camera.height, false);
    if (this.stale || key !== this._sorted) this.splats.prepare(camera);
    this._sorted = key;
    this.stale = false;
    this._draw(camera);
    this._again = again;
    clearTimeout(this._timer);
    if (again) this.invalidate();
    else if (this._inMotion()) this._timer = setTimeout(() => this.invalidate(), STILL_MS + 10);
  }

  _inMotion() { return performance.now() - this._movedAt < STILL_MS; }

  /** Adapt the resolution to the time between frames. @param {number} gap ms */
  _adapt(gap) {
    if (!(gap > 0) || gap > 4 * STILL_MS) return; // a pause is no slow frame
    this.frameMs += (gap - this.frameMs) * (this.frameMs ? 0.2 : 1);
    if (this.frameMs > SLOW_MS) this._scale = Math.max(this._scale * 0.9, LEAST_SCALE);
    else if (this.frameMs < QUICK_MS) this._scale = Math.min(this._scale * 1.05, 1);
  }

  /** @param {Pinhole} camera */
  _draw(camera) {
    const T = camera.T_map_camera, P = projection(camera);
    // The view frame has y up and z backward: the second and third columns change their sign.
    this._camera.matrix.set(T[0], -T[1], -T[2], T[3], T[4], -T[5], -T[6], T[7], T[8], -T[9], -T[10], T[11], 0, 0, 0, 1);
    this._camera.matrixWorldNeedsUpdate = true;
    this._camera.projectionMatrix.set(.../** @type {Parameters<import("three").Matrix4["set"]>} */ (/** @type {unknown} */ (P)));
    this._camera.projectionMatrixInverse.copy(this._camera.projectionMatrix).invert();
    this.splats.mesh.visible &&= this._gaussiansShown;
    this._renderer.render(this._scene, this._camera);
    this.splats.mesh.visible = this.splats.sorter.visible > 0;
  }
}

/** @param {HTMLCanvasElement} canvas @returns {WebGLRenderer} */
function makeRenderer(canvas) {
  const context = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, powerPreference: "high-performance" });
  if (!context) throw new Error("this browser has no WebGL 2, which the 3D map needs (is hardware acceleration switched off?)");
  const renderer = new WebGLRenderer({ canvas, context, alpha: false, antialias: false, depth: false });
  renderer.outputColorSpace = LinearSRGBColorSpace;
  renderer.setPixelRatio(1);
  return renderer;
}

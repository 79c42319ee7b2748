// The viewpoint: how orbit, fly, follow and first person move it. No events, no drawing: numbers only.
import { lookingPose } from "./pinhole.js";

/** @typedef {import("./pinhole.js").Point} Point */
/** @typedef {"orbit" | "fly" | "follow" | "first"} Mode */
/** @typedef {{x: number, y: number, z: number, yaw: number}} RobotPose map frame, m and rad */

export const MODES = /** @type {const} */ (["orbit", "fly", "follow", "first"]);
const STEEPEST = (89 * Math.PI) / 180; // pitch: straight up and down have no direction of "right"
const RADIANS_PER_PX = 0.005; // of a drag
const SPEED_M_S = 1.5; // of flying: a brisk walk
const FAST = 4; // times as fast with Shift
const SMOOTHING_S = 0.15; // time constant with which the viewpoint follows the robot
const TRANSITION_S = 0.5;
const EYE_HEIGHT_M = 0.4; // of first person, before a keyframe tells the height of the camera
const DISTANCE_M = [0.05, 500];

export class Navigation {
  /** @param {boolean} reducedMotion jump instead of moving smoothly */
  constructor(reducedMotion) {
    this.reducedMotion = reducedMotion;
    /** @type {Mode} */
    this.mode = "orbit";
    /** @type {Point} */
    this.eye = [-3, -3, 3];
    this.yaw = Math.PI / 4;
    this.pitch = -0.6;
    this.distance = 5; // from the eye to the point around which it orbits, m
    this.eyeHeight = EYE_HEIGHT_M;
    this.eyePitch = 0; // of first person, rad
    /** @type {RobotPose | null} */
    this.robot = null;
    /** @type {{from: number[], to: number[], elapsed: number} | null} */
    this._transition = null;
    this._headYaw = 0; // of first person: from the robot's heading to the view, rad
    this.velocity = [0, 0, 0]; // forward, right, up, each -1 to 1
    this.fast = false;
  }

  /** Unit vector in which the viewpoint looks. @returns {Point} */
  get forward() {
    const c = Math.cos(this.pitch);
    return [c * Math.cos(this.yaw), c * Math.sin(this.yaw), Math.sin(this.pitch)];
  }

  /** The point around which the viewpoint orbits. @returns {Point} */
  get pivot() {
    const f = this.forward;
    return [this.eye[0] + f[0] * this.distance, this.eye[1] + f[1] * this.distance, this.eye[2] + f[2] * this.distance];
  }

  /** @returns {number[]} T_map_camera, row-major [16] */
  get pose() {
    return lookingPose(this.eye, this.yaw, this.pitch);
  }

  /** Whether `step` will change the viewpoint. */
  get moving() {
    return this._transition !== null || this.velocity.some((v) => v !== 0) || this._behindRobot() > 1e-3;
  }

  /** @param {Mode} mode */
  setMode(mode) {
    this.mode = mode;
    this._headYaw = 0;
    if (mode === "follow" && this.robot) this.goTo({ pivot: [this.robot.x, this.robot.y, this.robot.z], distance: Math.min(this.distance, 4) });
    if (mode === "first" && this.robot) {
      const { x, y, z, yaw } = this.robot;
      this.goTo({ eye: [x, y, z + this.eyeHeight], yaw, pitch: this.eyePitch });
    }
  }

  /**
   * Turn the view by a drag: around the pivot in orbit and follow, else on the spot.
   * @param {number} dx @param {number} dy px
   */
  drag(dx, dy) {
    this._transition = null;
    const pivot = this.pivot, around = this.mode === "orbit" || this.mode === "follow";
    const sign = around ? -1 : 1; // the scene follows the pointer in all modes
    this.yaw += sign * dx * RADIANS_PER_PX;
    this._headYaw += sign * dx * RADIANS_PER_PX;
    this.pitch = clamp(this.pitch + sign * dy * RADIANS_PER_PX, -STEEPEST, STEEPEST);
    if (around) this._lookAt(pivot);
  }

  /**
   * Move sideways so that the pivot follows the pointer.
   * @param {number} dx @param {number} dy px @param {number} focalPx
   */
  pan(dx, dy, focalPx) {
    this._transition = null;
    if (this.mode === "follow") this.mode = "orbit";
    if (this.mode === "first") return;
    const metres = Math.max(this.distance, 0.5) / focalPx;
    this._move(0, -dx * metres, 0);
    const up = [-Math.sin(this.pitch) * Math.cos(this.yaw), -Math.sin(this.pitch) * Math.sin(this.yaw), Math.cos(this.pitch)];
    for (let k = 0; k < 3; k++) this.eye[k] += up[k] * dy * metres;
  }

  /**
   * Approach the pivot (orbit, follow) or move forward (fly).
   * @param {number} factor of the distance; < 1 approaches
   */
  zoom(factor) {
    this._transition = null;
    if (this.mode === "first") return;
    if (this.mode === "fly") { this._move(Math.log(1 / factor) * SPEED_M_S, 0, 0); return; }
    const pivot = this.pivot;
    this.distance = clamp(this.distance * factor, DISTANCE_M[0], DISTANCE_M[1]);
    this._lookAt(pivot);
  }

  /**
   * Move to a viewpoint, in `TRANSITION_S` or at once.
   * @param {{eye?: Point, pivot?: Point, yaw?: number, pitch?: number, distance?: number}} to
   * @param {boolean} [atOnce]
   */
  goTo(to, atOnce = this.reducedMotion) {
    const yaw = this.yaw + turn((to.yaw ?? this.yaw) - this.yaw), pitch = clamp(to.pitch ?? this.pitch, -STEEPEST, STEEPEST);
    const distance = to.distance ?? this.distance, c = Math.cos(pitch);
    const f = [c * Math.cos(yaw), c * Math.sin(yaw), Math.sin(pitch)];
    const eye = to.eye ?? (to.pivot ? to.pivot.map((v, k) => v - f[k] * distance) : this.eye);
    this._transition = { from: this._state(), to: [...eye, yaw, pitch, distance], elapsed: atOnce ? TRANSITION_S : 0 };
    if (atOnce) this.step(0);
  }

  /**
   * Advance the transition, the flight and the pursuit of the robot.
   * @param {number} seconds since the last step
   */
  step(seconds) {
    if (this._transition) this._advance(this._transition, seconds);
    else if (this.robot && (this.mode === "follow" || this.mode === "first")) this._pursue(seconds);
    if (this.velocity.some((v) => v !== 0) && this.mode !== "first") {
      this._transition = null;
      if (this.mode === "follow") this.mode = "orbit";
      const metres = seconds * SPEED_M_S * (this.fast ? FAST : 1);
      this._move(this.velocity[0] * metres, this.velocity[1] * metres, this.velocity[2] * metres);
    }
  }

  /** @param {{from: number[], to: number[], elapsed: number}} t @param {number} seconds */
  _advance(t, seconds) {
    t.elapsed += seconds;
    const s = Math.min(t.elapsed / TRANSITION_S, 1), ease = s * s * (3 - 2 * s);
    const now = t.from.map((v, i) => v + (t.to[i] - v) * ease);
    this.eye = [now[0], now[1], now[2]];
    [this.yaw, this.pitch, this.distance] = now.slice(3);
    if (s >= 1) this._transition = null;
  }

  /** @param {number} seconds */
  _pursue(seconds) {
    const robot = /** @type {RobotPose} */ (this.robot), share = this.reducedMotion ? 1 : 1 - Math.exp(-seconds / SMOOTHING_S);
    const target = this.mode === "first" ? [robot.x, robot.y, robot.z + this.eyeHeight] : [robot.x, robot.y, robot.z];
    const from = this.mode === "first" ? this.eye : this.pivot;
    for (let k = 0; k < 3; k++) this.eye[k] += (target[k] - from[k]) * share;
    if (this.mode === "first") this.yaw += turn(robot.yaw + this._headYaw - this.yaw) * share;
  }

  /** How far the viewpoint is from where the robot wants it (m, or rad). */
  _behindRobot() {
    if (!this.robot || (this.mode !== "follow" && this.mode !== "first")) return 0;
    const { x, y, z, yaw } = this.robot, at = this.mode === "first" ? this.eye : this.pivot;
    const up = this.mode === "first" ? this.eyeHeight : 0;
    const gap = Math.hypot(x - at[0], y - at[1], z + up - at[2]);
    return this.mode === "first" ? Math.max(gap, Math.abs(turn(yaw + this._headYaw - this.yaw))) : gap;
  }

  /** @param {number} ahead @param {number} right @param {number} up m; ahead is along the view, up along z */
  _move(ahead, right, up) {
    const f = this.forward;
    this.eye[0] += f[0] * ahead + Math.sin(this.yaw) * right;
    this.eye[1] += f[1] * ahead - Math.cos(this.yaw) * right;
    this.eye[2] += f[2] * ahead + up;
  }

  /** Place the eye so that it looks at `pivot` from its distance. @param {Point} pivot */
  _lookAt(pivot) {
    const f = this.forward;
    this.eye = [pivot[0] - f[0] * this.distance, pivot[1] - f[1] * this.distance, pivot[2] - f[2] * this.distance];
  }

  _state() {
    return [...this.eye, this.yaw, this.pitch, this.distance];
  }
}

/** @param {number} v @param {number} low @param {number} high */
const clamp = (v, low, high) => Math.min(Math.max(v, low), high);

/** Return an angle in (-pi, pi]. @param {number} angle rad */
const turn = (angle) => Math.atan2(Math.sin(angle), Math.cos(angle));

// What is drawn over and under the Gaussians: floor plan, path, scan, robot, keyframes, measured points. All in the map frame.
import {
  BufferAttribute, BufferGeometry, CanvasTexture, DoubleSide, Group, Line, LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial,
  NearestFilter, PlaneGeometry, Points, PointsMaterial,
} from "three";
import { transform } from "./pinhole.js";

/** @typedef {import("./pinhole.js").Point} Point */
/** @typedef {"plan" | "path" | "scan" | "robot" | "keyframes" | "measure"} Layer */

const COLOURS = { path: 0x58a6ff, scan: 0xff4d4d, robot: 0xe8590c, keyframes: 0xd4a72c, measure: 0x4ac26b };
const FRUSTUM_M = 0.15; // depth of a drawn frustum
const PLAN_Z_M = -0.02; // below the Gaussians of the floor
const PATH_Z_M = 0.02;
const ROBOT_M = 0.35; // length of the arrow

/** Layers as objects of three.js; `group.children` are hidden and shown by `show`. */
export class Overlays {
  constructor() {
    this.group = new Group();
    /** @type {Record<Layer, Group>} */
    this._layers = { plan: new Group(), path: new Group(), scan: new Group(), robot: new Group(), keyframes: new Group(), measure: new Group() };
    this.group.add(...Object.values(this._layers));
    this._layers.robot.add(arrow());
    this._layers.robot.visible = false;
    this._hasRobot = false;
    this._hidden = new Set();
  }

  /** @param {Layer} layer @param {boolean} visible */
  show(layer, visible) {
    if (visible) this._hidden.delete(layer); else this._hidden.add(layer);
    this._layers[layer].visible = visible && (layer !== "robot" || this._hasRobot);
  }

  /** @param {{x: number, y: number, z: number, yaw: number} | null} robot */
  setRobot(robot) {
    const layer = this._layers.robot;
    this._hasRobot = robot !== null;
    layer.visible = robot !== null && !this._hidden.has("robot");
    if (!robot) return;
    layer.position.set(robot.x, robot.y, robot.z + PATH_Z_M);
    layer.rotation.z = robot.yaw;
  }

  /** @param {number[]} cm x, y, x, y ... */
  setPath(cm) {
    const points = new Float32Array((cm.length / 2) * 3);
    for (let i = 0; i < cm.length / 2; i++) points.set([cm[2 * i] / 100, cm[2 * i + 1] / 100, PATH_Z_M], 3 * i);
    this._replace("path", points.length ? [new Line(vertices(points), line(COLOURS.path))] : []);
  }

  /** @param {{T_map_lidar: number[], points: number[][]}} scan points [N][2] in the lidar frame, m */
  setScan({ T_map_lidar, points }) {
    const at = new Float32Array(points.length * 3);
    points.forEach(([x, y], i) => at.set(transform(T_map_lidar, [x, y, 0]), 3 * i));
    const material = new PointsMaterial({ color: COLOURS.scan, size: 4, sizeAttenuation: false, depthTest: false, transparent: true });
    this._replace("scan", [over(new Points(vertices(at), material))]);
  }

  /**
   * @param {HTMLImageElement} image of the grid, north up
   * @param {{x_m: number, y_m: number, cell_m: number, width: number, height: number}} place of its lower left corner, and size
   */
  setPlan(image, place) {
    const canvas = document.createElement("canvas");
    canvas.width = image.naturalWidth;
    canvas.height = image.naturalHeight;
    /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d")).drawImage(image, 0, 0);
    const texture = new CanvasTexture(canvas);
    texture.magFilter = NearestFilter;
    const width = place.width * place.cell_m, height = place.height * place.cell_m;
    const plane = new Mesh(new PlaneGeometry(width, height), new MeshBasicMaterial({ map: texture, side: DoubleSide, transparent: true, opacity: 0.5, depthTest: false, depthWrite: false }));
    plane.position.set(place.x_m + width / 2, place.y_m + height / 2, PLAN_Z_M);
    plane.renderOrder = 0;
    this._replace("plan", [plane]);
  }

  /**
   * @param {{T_map_camera: number[]}[]} keyframes
   * @param {{width: number, height: number, K: number[]}} camera
   */
  setKeyframes(keyframes, camera) {
    this._replace("keyframes", keyframes.length ? [new LineSegments(vertices(frustums(keyframes, camera)), line(COLOURS.keyframes))] : []);
  }

  /** @param {Point[]} points one or two */
  setMeasure(points) {
    const at = new Float32Array(points.flat());
    const material = new PointsMaterial({ color: COLOURS.measure, size: 9, sizeAttenuation: false, depthTest: false, transparent: true });
    this._replace("measure", points.length ? [over(new Points(vertices(at), material)), new Line(vertices(at), line(COLOURS.measure))] : []);
  }

  dispose() {
    for (const layer of Object.keys(this._layers)) this._replace(/** @type {Layer} */ (layer), []);
  }

  /** @param {Layer} layer @param {(Mesh | Line | Points)[]} objects */
  _replace(layer, objects) {
    const group = this._layers[layer];
    for (const old of /** @type {any[]} */ ([...group.children])) {
      old.geometry.dispose();
      old.material.map?.dispose();
      old.material.dispose();
    }
    group.clear();
    if (objects.length) group.add(...objects.map((o) => (layer === "plan" ? o : over(o))));
  }
}

/** Draw an object after the Gaussians; its material must be transparent, because three.js draws opaque ones first. @template {Mesh | Line | Points} T @param {T} object @returns {T} */
function over(object) {
  object.renderOrder = 2;
  object.frustumCulled = false;
  return object;
}

/** @param {number} color */
const line = (color) => new LineBasicMaterial({ color, depthTest: false, transparent: true });

/** @param {Float32Array} points x y z ... @returns {BufferGeometry} */
function vertices(points) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(points, 3));
  return geometry;
}

/** @returns {Mesh} an arrow on the floor that points along x */
function arrow() {
  const s = ROBOT_M / 2, at = new Float32Array([1.3 * s, 0, 0, -s, 0.8 * s, 0, -0.6 * s, 0, 0, 1.3 * s, 0, 0, -0.6 * s, 0, 0, -s, -0.8 * s, 0]);
  return over(new Mesh(vertices(at), new MeshBasicMaterial({ color: COLOURS.robot, side: DoubleSide, depthTest: false, transparent: true })));
}

/**
 * Return the edges of frustums as pairs of points.
 * @param {{T_map_camera: number[]}[]} keyframes @param {{width: number, height: number, K: number[]}} camera
 */
function frustums(keyframes, { width, height, K }) {
  const corners = [[0, 0], [width, 0], [width, height], [0, height]]
    .map(([u, v]) => [((u - 0.5 - K[2]) / K[0]) * FRUSTUM_M, ((v - 0.5 - K[5]) / K[4]) * FRUSTUM_M, FRUSTUM_M]);
  const at = new Float32Array(keyframes.length * 48);
  keyframes.forEach(({ T_map_camera }, k) => {
    const eye = transform(T_map_camera, [0, 0, 0]), c = corners.map((p) => transform(T_map_camera, p));
    const edges = [0, 1, 2, 3].flatMap((i) => [eye, c[i], c[i], c[(i + 1) % 4]]);
    at.set(edges.flat(), 48 * k);
  });
  return at;
}

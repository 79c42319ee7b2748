// Poses, projection, sorting, picking, levels and navigation against truth that is computed another way.
import assert from "node:assert/strict";
import { test } from "node:test";
import { WORDS } from "../src/codec.js";
import { chooseLevels, distanceToBox } from "../src/levels.js";
import { Navigation } from "../src/navigation.js";
import { measure, pick } from "../src/picking.js";
import { fitted, forward, inverse, lookingPose, origin, project, projection, ray, transform } from "../src/pinhole.js";
import { DepthSorter } from "../src/sorting.js";

const close = (actual, expected, tolerance) => expected.forEach((v, i) => assert.ok(Math.abs(actual[i] - v) <= tolerance, `${actual} is not ${expected}`));
const camera = { T_map_camera: lookingPose([0, 0, 1], 0, 0), fx: 200, fy: 210, cx: 159.5, cy: 121, width: 320, height: 240 };

/** Seeded numbers in [0, 1). */
function generator(seed) {
  return () => { seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0; return seed / 2 ** 32; };
}

/** Records of round Gaussians: [[x, y, z, sigma, opacity], ...]. */
function round(gaussians) {
  const words = new Uint32Array(gaussians.length * WORDS), floats = new Float32Array(words.buffer);
  gaussians.forEach(([x, y, z, sigma, opacity], i) => {
    floats.set([x, y, z], i * WORDS);
    words[i * WORDS + 3] = (Math.round(opacity * 255) << 24) >>> 0;
    floats.set([sigma ** 2, 0, 0, sigma ** 2, 0, sigma ** 2, sigma], i * WORDS + 4);
  });
  return floats;
}

test("a pose looks along yaw and pitch, with x to the right and y down", () => {
  const T = lookingPose([1, 2, 3], Math.PI / 2, 0); // along +y of the map
  close(forward(T), [0, 1, 0], 1e-12);
  close(transform(T, [1, 0, 0]), [2, 2, 3], 1e-12); // right of +y is +x
  close(transform(T, [0, 1, 0]), [1, 2, 2], 1e-12); // down
  close(forward(lookingPose([0, 0, 0], 0, 0.3)), [Math.cos(0.3), 0, Math.sin(0.3)], 1e-12);
  const random = generator(1), U = lookingPose([random(), random(), random()], 6 * random(), random());
  close(transform(inverse(U), transform(U, [0.1, 0.2, 0.3])), [0.1, 0.2, 0.3], 1e-12);
});

test("projection, ray and WebGL's matrix agree", () => {
  const point = [4, -0.7, 1.3], [u, v] = project(camera, point); // 0.7 m to the right, 0.3 m up, 4 m ahead
  close([u, v], [159.5 + (200 * 0.7) / 4, 121 - (210 * 0.3) / 4], 1e-9);
  const d = ray(camera, u, v), n = Math.hypot(4, 0.7, 0.3);
  close(d, [4 / n, -0.7 / n, 0.3 / n], 1e-12);
  const P = projection(camera), view = [0.7, 0.3, -4, 1];
  const clip = [0, 1, 2, 3].map((r) => [0, 1, 2, 3].reduce((sum, c) => sum + P[4 * r + c] * view[c], 0));
  // Pixel centres are integers, so the image goes from -0.5 to width - 0.5.
  close([((clip[0] / clip[3] + 1) * 320) / 2 - 0.5, ((1 - clip[1] / clip[3]) * 240) / 2 - 0.5], [u, v], 1e-9);
  assert.equal(project(camera, [-1, 0, 1]), null);
});

test("an image is fitted into a window in its middle", () => {
  const { camera: window, left, top, scale } = fitted(camera, 1000, 480);
  close([left, top, scale], [180, 0, 2], 1e-12);
  const [u, v] = project(camera, [3, 0.2, 0.8]), [U, V] = project(window, [3, 0.2, 0.8]);
  close([U, V], [180 + 2 * (u + 0.5) - 0.5, 2 * (v + 0.5) - 0.5], 1e-9);
});

test("Gaussians are drawn from far to near, and only those that can be seen", () => {
  const random = generator(7), gaussians = Array.from({ length: 5000 }, () => [20 * random() - 10, 20 * random() - 10, 3 * random(), 0.02, 0.9]);
  const records = round(gaussians), sorter = new DepthSorter();
  sorter.sort(records, gaussians.length, camera, [0.5, 2]);
  const seen = [...sorter.order.subarray(0, sorter.visible)], depths = seen.map((i) => gaussians[i][0]);
  for (let i = 1; i < depths.length; i++) assert.ok(depths[i] <= depths[i - 1] + 0.001, "farther ones first, within a bucket of 0.3 mm");
  const inside = gaussians.flatMap((g, i) => {
    const px = project(camera, g), between = g[2] >= 0.5 && g[2] <= 2;
    return px && between && px[0] > -0.5 && px[0] < 319.5 && px[1] > -0.5 && px[1] < 239.5 ? [i] : [];
  });
  const kept = new Set(seen);
  assert.ok(inside.length > 100 && inside.every((i) => kept.has(i)), "none in the image is missing");
  assert.ok(seen.length < 1.5 * inside.length, "few outside the image are kept");
  assert.ok(seen.every((i) => gaussians[i][2] >= 0.5 && gaussians[i][2] <= 2), "slice by height");
});

test("a ray ends at the first opaque surface", () => {
  const wall = (x, opacity) => Array.from({ length: 400 }, (_, i) => [x, ((i % 20) - 9.5) * 0.05, 1 + (Math.floor(i / 20) - 9.5) * 0.05, 0.03, opacity]);
  const haze = wall(2, 0.02), front = wall(3, 0.8), back = wall(5, 0.99), all = [...back, ...haze, ...front], records = round(all);
  close(pick(records, all.length, [0, 0, 1], [1, 0, 0], [-Infinity, Infinity]), [3, 0, 1], 0.03);
  assert.equal(pick(records, all.length, [0, 0, 1], [-1, 0, 0], [-Infinity, Infinity]), null);
  assert.equal(pick(records, all.length, [0, 0, 1], [1, 0, 0], [2, 3]), null, "cut off by the slice");
  assert.equal(pick(round(haze), haze.length, [0, 0, 1], [1, 0, 0], [-Infinity, Infinity]), null, "haze is no surface");
  const m = measure([1, 2, 0.5], [4, 6, 1.7]);
  close([m.distance, m.horizontal, m.height], [Math.hypot(3, 4, 1.2), 5, 1.2], 1e-12);
});

test("levels of detail follow distance and budget", () => {
  const identity = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
  const levels = [[0, 1000], [0.02, 600], [0.04, 300], [0.08, 100]].map(([cell_m, count]) => ({ cell_m, count, bytes: 8 * count }));
  const chunks = [0, 1, 2, 3].map((i) => ({ anchor: i, revision: 1, T_map_anchor: identity.with(3, 10 * i), low: [0, 0, 0], high: [1, 1, 1], levels }));
  close([distanceToBox(chunks[1], [0, 0.5, 0.5])], [10], 1e-12);
  const cells = (budget) => [...chooseLevels(chunks, [0.5, 0.5, 0.5], 500, budget)].sort(([a], [b]) => a - b).map(([, level]) => level.cell_m);
  // A cell may appear one pixel large: 9.5 m / 500 px = 1.9 cm, 3.9 cm, 5.9 cm.
  assert.deepEqual(cells(1e6), [0, 0, 0.02, 0.04]);
  const total = (budget) => cells(budget).reduce((sum, cell) => sum + levels.find((l) => l.cell_m === cell).count, 0);
  for (const budget of [2500, 1800, 1400]) assert.ok(total(budget) <= budget && cells(budget)[0] === 0, "the nearest keeps its detail");
  assert.deepEqual(cells(250), [0.08, 0.08], "too small for all: the nearest ones");
  assert.deepEqual(cells(1), [0.08], "never nothing");
});

test("orbit keeps the distance, fly and pan move, first person and follow go with the robot", () => {
  const n = new Navigation(true);
  n.goTo({ pivot: [1, 2, 0.5], distance: 4, yaw: 0.3, pitch: -0.5 });
  n.drag(120, -80);
  close(n.pivot, [1, 2, 0.5], 1e-9);
  close([Math.hypot(n.eye[0] - 1, n.eye[1] - 2, n.eye[2] - 0.5)], [4], 1e-9);
  n.zoom(0.5);
  close([n.distance, ...n.pivot], [2, 1, 2, 0.5], 1e-9);
  n.drag(0, 5000);
  assert.ok(Math.abs(n.pitch) < Math.PI / 2, "never upside down");
  n.goTo({ eye: [0, 0, 1], yaw: 0, pitch: 0 });
  n.setMode("fly");
  n.velocity = [1, 0, 0];
  n.step(2);
  close(n.eye, [3, 0, 1], 1e-9); // 1.5 m/s
  n.velocity = [0, 1, 0];
  n.step(1);
  close(n.eye, [3, -1.5, 1], 1e-9); // to the right
  n.velocity = [0, 0, 0];
  n.robot = { x: 5, y: 1, z: 0, yaw: Math.PI / 2 };
  n.eyeHeight = 0.3;
  n.setMode("first");
  close([...n.eye, n.yaw], [5, 1, 0.3, Math.PI / 2], 1e-9);
  n.robot = { x: 5, y: 2, z: 0, yaw: Math.PI };
  assert.ok(n.moving);
  n.step(0.1);
  close([...n.eye, Math.cos(n.yaw)], [5, 2, 0.3, -1], 1e-9);
  assert.ok(!n.moving);
  n.setMode("follow");
  n.robot = { x: 7, y: 2, z: 0, yaw: 0 };
  n.step(0.1);
  close(n.pivot, [7, 2, 0], 1e-9);
});

test("without reduced motion the viewpoint moves smoothly", () => {
  const n = new Navigation(false), before = [...n.eye];
  n.goTo({ eye: [0, 0, 1], yaw: 0, pitch: 0 });
  close(n.eye, before, 0);
  n.step(0.25);
  close(n.eye, before.map((v, k) => (v + [0, 0, 1][k]) / 2), 1e-9); // half of 0.5 s
  n.step(0.25);
  close([...n.eye, n.yaw], [0, 0, 1, 0], 1e-9);
  close(origin(n.pose), [0, 0, 1], 1e-9);
});

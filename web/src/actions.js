// What buttons, keys and the pointer do with a viewer.
import { MODES } from "./navigation.js";
import { focalPx } from "./pinhole.js";

/** @typedef {import("./viewer.js").Viewer} Viewer */

/** @param {Viewer} viewer @returns {import("./panel.js").PanelActions} */
export function panelActions(viewer) {
  const { scene } = viewer, redraw = () => scene.invalidate();
  return {
    mode: (mode) => viewer.setMode(mode),
    whole: () => viewer.whole(),
    measuring: () => viewer.setMeasuring(!viewer.measuring.on),
    screenshot: () => { viewer.save(); },
    compareNearest: () => viewer.compareNearest(),
    compare: (index) => viewer.compare(index),
    layer: (layer, visible) => { scene.show(layer, visible); redraw(); },
    shading: (shading) => { scene.splats.shade(shading); redraw(); },
    budget: (budget) => { viewer.budget = budget; viewer.choose(); redraw(); },
    heights: (low, high) => { scene.splats.heights = [low, high]; scene.stale = true; redraw(); },
  };
}

/** @param {Viewer} viewer @returns {import("./controls.js").ControlActions} */
export function controlActions(viewer) {
  const { canvas } = viewer;
  /** @type {Record<string, () => void>} */
  const keys = {
    0: () => viewer.whole(), m: () => viewer.setMeasuring(!viewer.measuring.on), c: () => viewer.compareNearest(),
    Escape: () => { viewer.endComparison(); viewer.setMeasuring(false); },
    Enter: () => viewer.measureAt(canvas.clientWidth / 2, canvas.clientHeight / 2),
  };
  MODES.forEach((mode, i) => { keys[i + 1] = () => viewer.setMode(mode); });
  return {
    changed: () => viewer.moved(),
    focalPx: () => focalPx(canvas.clientHeight),
    click: (x, y) => viewer.click(x, y),
    hover: (x, y) => viewer.hover(x, y),
    key: (key) => {
      const act = keys[key.length === 1 ? key.toLowerCase() : key];
      act?.();
      return act !== undefined;
    },
  };
}

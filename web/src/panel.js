// The controls of the viewer: a bar with buttons, options that open from it, and lines of text.
import { checkbox, choice, h, press, toggle } from "./dom.js";
import { DEPTH_RANGE_M, SIGMA_RANGE_M } from "./splats.js";

/** @typedef {import("./navigation.js").Mode} Mode */
/** @typedef {import("./overlays.js").Layer} Layer */

/**
 * What the controls do.
 * @typedef {{
 *   mode: (mode: Mode) => void, whole: () => void, measuring: () => void, screenshot: () => void, compareNearest: () => void,
 *   compare: (index: number) => void, layer: (layer: Layer | "gaussians", visible: boolean) => void,
 *   shading: (shading: import("./splats.js").Shading) => void, budget: (gaussians: number) => void,
 *   heights: (low: number, high: number) => void,
 * }} PanelActions
 */

/** @type {[Mode, string, string][]} */
const MODES = [
  ["orbit", "Orbit", "Turn around a point of the map (key 1)"],
  ["fly", "Fly", "Move freely with W A S D, Q and E (key 2)"],
  ["follow", "Follow", "Keep the robot in the middle (key 3)"],
  ["first", "Robot's eyes", "Look from the robot (key 4)"],
];
/** @type {[Layer | "gaussians", string][]} */
const LAYERS = [
  ["gaussians", "Gaussians"], ["plan", "Floor plan"], ["path", "Path"], ["scan", "Scan"], ["robot", "Robot"], ["keyframes", "Keyframes"],
];
const BUDGETS = [50_000, 100_000, 300_000, 1_000_000];
const LEGENDS = {
  colour: "",
  depth: `Depth: ${DEPTH_RANGE_M[0]} m is red, ${DEPTH_RANGE_M[1]} m and more is blue.`,
  uncertainty: `Size of the Gaussians (largest standard deviation): ${SIGMA_RANGE_M[0] * 1000} mm and less is blue (surfaces seen in detail), ${SIGMA_RANGE_M[1]} m and more is red (seen from far away or rarely).`,
};
const KEYS = "Keys (on the picture): arrows turn, Shift and arrows move sideways, + and − zoom, W A S D Q E fly (with Shift faster), 1 to 4 choose the movement, M measures, Enter picks the middle, C compares, Esc ends. Drag turns, two fingers or the right button move, wheel or pinch zoom.";
const SLICE_STEP_M = 0.05;

export class Panel {
  /** @param {PanelActions} actions @param {number} budget number of Gaussians */
  constructor(actions, budget) {
    this._actions = actions;
    this._mode = "";
    /** @type {Record<string, HTMLButtonElement>} */
    this._modes = Object.fromEntries(MODES.map(([mode, text, title]) => [mode, toggle(text, title, () => actions.mode(mode))]));
    this._measure = toggle("Measure", "Distance of two points, and their height (key M)", actions.measuring);
    this._compare = h("button", { type: "button", title: "Go to the nearest keyframe and put its image over the render (key C)", onclick: actions.compareNearest, disabled: true }, "Compare");
    this.status = h("p", { className: "v3-status", role: "status" });
    this.facts = h("p", { className: "v3-facts" });
    this._note = h("p", { className: "v3-facts" });
    const sliced = () => this._sliced();
    this._low = slider("Lowest height that is shown, m", { step: String(SLICE_STEP_M), oninput: sliced });
    this._high = slider("Greatest height that is shown, m", { step: String(SLICE_STEP_M), oninput: sliced });
    this._heightText = h("output", {});
    this._keyframeText = h("output", {}, "none");
    this._keyframe = slider("Keyframe that is compared", { disabled: true, onchange: () => actions.compare(Number(this._keyframe.value)) });
    this._legend = h("p", { className: "v3-legend", hidden: true });
    this.bar = h("div", { className: "v3-bar", role: "toolbar", "aria-label": "Controls of the 3D map" },
      h("div", { className: "v3-group", role: "group", "aria-label": "Movement" }, ...Object.values(this._modes)),
      h("button", { type: "button", title: "Show the whole map (key 0)", onclick: actions.whole }, "Whole map"),
      this._measure, this._compare,
      h("button", { type: "button", title: "Save this picture as a file", onclick: actions.screenshot }, "Screenshot"),
      this._options(budget));
    this.text = h("div", { className: "v3-text" }, this.status, this._note, this.facts, this._legend);
    this.setRobot(false);
    this.setMode("orbit");
  }

  /** @param {Mode} mode */
  setMode(mode) {
    if (mode === this._mode) return;
    this._mode = mode;
    for (const [name, button] of Object.entries(this._modes)) press(button, name === mode);
  }

  /** @param {boolean} known whether there is a pose of the robot */
  setRobot(known) { for (const mode of ["follow", "first"]) this._modes[mode].disabled = !known; }

  /** @param {boolean} on */
  setMeasuring(on) { press(this._measure, on); }

  /** @param {string} text why the map is not complete */
  note(text) { if (this._note.textContent !== text) this._note.textContent = text; }

  /** Say something, to screen readers too. @param {string} text */
  say(text) { if (this.status.textContent !== text) this.status.textContent = text; }

  /** @param {number} count of keyframes that can be compared */
  setKeyframes(count) {
    this._compare.disabled = !count;
    this._keyframe.max = String(Math.max(count - 1, 0));
    this._keyframe.disabled = !count;
    this._keyframeText.textContent = count ? `${Number(this._keyframe.value) + 1} of ${count}` : "none";
  }

  /** @param {number} index of the keyframe that is compared */
  setKeyframe(index) {
    this._keyframe.value = String(index);
    this._keyframeText.textContent = `${index + 1} of ${Number(this._keyframe.max) + 1}`;
  }

  /** Set the ends of the height sliders. @param {number} low @param {number} high m */
  setHeights(low, high) {
    const all = [Number(this._low.value) <= Number(this._low.min), Number(this._high.value) >= Number(this._high.max)];
    for (const slider of [this._low, this._high]) {
      slider.min = (Math.floor(low / SLICE_STEP_M) * SLICE_STEP_M).toFixed(2);
      slider.max = (Math.ceil(high / SLICE_STEP_M) * SLICE_STEP_M).toFixed(2);
    }
    if (all[0]) this._low.value = this._low.min;
    if (all[1]) this._high.value = this._high.max;
    this._sliced();
  }

  /** @param {number} budget */
  _options(budget) {
    const layers = LAYERS.map(([layer, text]) => checkbox(text, true, (visible) => this._actions.layer(layer, visible)));
    const shading = choice("Shading", [["colour", "colour"], ["depth", "depth"], ["uncertainty", "size (uncertainty)"]], "colour", (value) => {
      const shade = /** @type {import("./splats.js").Shading} */ (value);
      this._legend.textContent = LEGENDS[shade];
      this._legend.hidden = !LEGENDS[shade];
      this._actions.shading(shade);
    });
    const budgets = choice("Detail", BUDGETS.map((n) => [String(n), `${n.toLocaleString("en")} Gaussians`]), String(budget), (n) => this._actions.budget(Number(n)));
    return h("details", { className: "v3-options" }, h("summary", {}, "Options"),
      h("div", { className: "v3-sheet" },
        h("fieldset", {}, h("legend", {}, "Show"), ...layers),
        h("fieldset", {}, h("legend", {}, "Heights "), this._heightText, this._low, this._high),
        h("fieldset", {}, h("legend", {}, "Keyframe "), this._keyframeText, this._keyframe),
        shading, budgets, h("p", { className: "v3-keys" }, KEYS)));
  }

  _sliced() {
    const [a, b] = [Number(this._low.value), Number(this._high.value)];
    const low = Math.min(a, b), high = Math.max(a, b);
    this._heightText.textContent = `${low.toFixed(2)} m to ${high.toFixed(2)} m`;
    this._actions.heights(low <= Number(this._low.min) ? -Infinity : low, high >= Number(this._high.max) ? Infinity : high);
  }
}

/** @param {string} label @param {Record<string, any>} properties @returns {HTMLInputElement} a slider from 0 to 0 */
function slider(label, properties) {
  return h("input", { type: "range", min: "0", max: "0", value: "0", "aria-label": label, ...properties });
}

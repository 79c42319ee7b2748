// Pointer, touch, wheel and keys of the canvas, translated to `Navigation`.

/** @typedef {import("./navigation.js").Navigation} Navigation */

const CLICK_PX = 5; // a pointer that moved less was a click
const ZOOM_PER_PX = 1 / 500; // of the wheel
const TURN_PX = 24; // of a drag that an arrow key equals
/** @type {Record<string, [number, number]>} axis and sign of Navigation.velocity by the physical key (WASD on any layout) */
const FLIGHT = { KeyW: [0, 1], KeyS: [0, -1], KeyD: [1, 1], KeyA: [1, -1], KeyE: [2, 1], KeyQ: [2, -1] };
/** @type {Record<string, [number, number]>} */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/**
 * @typedef {{
 *   changed: () => void,
 *   focalPx: () => number,
 *   click: (x: number, y: number) => void,
 *   hover: (x: number, y: number) => void,
 *   key: (key: string) => boolean,
 * }} ControlActions x and y in CSS px from the canvas's corner; `hover` gets NaN when the pointer leaves; `key` returns
 *   whether it took the key
 */

/**
 * Let a canvas control a viewpoint.
 * @param {HTMLCanvasElement} canvas @param {Navigation} navigation @param {ControlActions} actions
 */
export function attachControls(canvas, navigation, actions) {
  /** @type {Map<number, {x: number, y: number, travelled: number}>} */
  const pointers = new Map();
  let touches = 0; // most fingers of the current gesture: a pinch is no click

  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    pointers.set(e.pointerId, { x: e.offsetX, y: e.offsetY, travelled: 0 });
    touches = Math.max(touches, pointers.size);
  });
  canvas.addEventListener("pointermove", (e) => {
    const before = pointers.get(e.pointerId);
    if (!before) { actions.hover(e.offsetX, e.offsetY); return; }
    const dx = e.offsetX - before.x, dy = e.offsetY - before.y;
    const other = [...pointers.entries()].find(([id]) => id !== e.pointerId)?.[1];
    pointers.set(e.pointerId, { x: e.offsetX, y: e.offsetY, travelled: before.travelled + Math.hypot(dx, dy) });
    if (other) {
      const gap = Math.hypot(e.offsetX - other.x, e.offsetY - other.y) + 1, old = Math.hypot(before.x - other.x, before.y - other.y) + 1;
      navigation.zoom(old / gap);
      navigation.pan(dx / 2, dy / 2, actions.focalPx()); // the middle of two fingers moves by half
    } else if (e.buttons > 1 || e.shiftKey) navigation.pan(dx, dy, actions.focalPx());
    else navigation.drag(dx, dy);
    actions.changed();
  });
  canvas.addEventListener("pointerup", (e) => {
    const pointer = pointers.get(e.pointerId);
    pointers.delete(e.pointerId);
    if (pointer && touches === 1 && pointer.travelled < CLICK_PX) actions.click(e.offsetX, e.offsetY);
    if (!pointers.size) touches = 0;
  });
  canvas.addEventListener("pointercancel", (e) => { pointers.delete(e.pointerId); if (!pointers.size) touches = 0; });
  canvas.addEventListener("pointerleave", () => actions.hover(NaN, NaN));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault()); // the right button pans
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    navigation.zoom(Math.exp(e.deltaY * (e.deltaMode ? 16 : 1) * ZOOM_PER_PX));
    actions.changed();
  }, { passive: false });
  attachKeys(canvas, navigation, actions);
}

/** @param {HTMLCanvasElement} canvas @param {Navigation} navigation @param {ControlActions} actions */
function attachKeys(canvas, navigation, actions) {
  const stop = () => { navigation.velocity = [0, 0, 0]; };
  canvas.addEventListener("keydown", (e) => {
    if (e.ctrlKey || e.altKey || e.metaKey) return; // the browser's own
    navigation.fast = e.shiftKey;
    const arrow = ARROWS[e.key], flight = FLIGHT[e.code];
    if (arrow && e.shiftKey) navigation.pan(-arrow[0] * TURN_PX, -arrow[1] * TURN_PX, actions.focalPx());
    else if (arrow) navigation.drag(turnSign(navigation) * arrow[0] * TURN_PX, turnSign(navigation) * arrow[1] * TURN_PX);
    else if (e.key === "+" || e.key === "=") navigation.zoom(0.85);
    else if (e.key === "-" || e.key === "_") navigation.zoom(1 / 0.85);
    else if (flight) navigation.velocity[flight[0]] = flight[1];
    else {
      if (actions.key(e.key)) e.preventDefault();
      return;
    }
    e.preventDefault();
    actions.changed();
  });
  canvas.addEventListener("keyup", (e) => {
    navigation.fast = e.shiftKey;
    const flight = FLIGHT[e.code];
    if (flight) navigation.velocity[flight[0]] = 0;
  });
  canvas.addEventListener("blur", stop); // the key is released elsewhere
}

/** An arrow key turns the view to its side in every mode. @param {Navigation} navigation */
const turnSign = (navigation) => (navigation.mode === "orbit" || navigation.mode === "follow" ? 1 : -1);

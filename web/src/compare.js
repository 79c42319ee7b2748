// A keyframe's image over the render from its pose, with a slider between them.
import { h } from "./dom.js";

export class Comparison {
  /** @param {() => void} close @param {boolean} canRender the server can render a reference image */
  constructor(close, canRender) {
    this._urls = { camera: "", render: "" };
    this._image = h("img", { className: "v3-image", alt: "", onerror: () => this._say("This keyframe's image is not kept."), onload: () => this._say("") });
    this._slider = h("input", { type: "range", min: "0", max: "100", value: "50", "aria-label": "Border between the 3D view (left) and the image (right)", oninput: () => this._cut() });
    this._source = h("select", { "aria-label": "Image on the right", onchange: () => this._load() },
      h("option", { value: "camera" }, "Camera image"), h("option", { value: "render" }, "Render by the mapper"));
    this._source.hidden = !canRender;
    this._title = h("span", {});
    this._fault = h("span", { role: "status" });
    const closing = h("button", { type: "button", onclick: close }, "Close");
    this.element = h("div", { className: "v3-compare", hidden: true, role: "group", "aria-label": "Comparison with a keyframe" },
      this._image, h("div", { className: "v3-compare-bar" }, this._title, this._slider, this._source, this._fault, closing));
  }

  /**
   * Show the comparison with a keyframe.
   * @param {string} title @param {{camera: string, render: string}} urls of the images
   */
  open(title, urls) {
    this._urls = urls;
    this._title.textContent = title;
    this.element.hidden = false;
    this._load();
    this._cut();
  }

  /** Place the image over the canvas. @param {number} left @param {number} top @param {number} width @param {number} height CSS px */
  place(left, top, width, height) {
    Object.assign(this._image.style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
  }

  close() {
    this.element.hidden = true;
    this._image.removeAttribute("src");
  }

  _load() {
    const camera = this._source.value !== "render";
    this._image.alt = camera ? "Image of the camera" : "Render by the mapper";
    const url = camera ? this._urls.camera : this._urls.render;
    if (!url) return;
    this._say("Loading ...");
    this._image.src = url;
  }

  _cut() { this._image.style.clipPath = `inset(0 0 0 ${this._slider.value}%)`; }

  /** @param {string} text */
  _say(text) { this._fault.textContent = text; }
}

// The Gaussians as one instanced mesh of three.js: their records in a texture, their order as an instance attribute.
import {
  BufferAttribute, CustomBlending, DataTexture, DynamicDrawUsage, GLSL3, InstancedBufferAttribute, InstancedBufferGeometry, Mesh,
  OneFactor, OneMinusSrcAlphaFactor, RGBAIntegerFormat, RawShaderMaterial, UnsignedIntType, Vector2,
} from "three";
import { WORDS } from "./codec.js";
import { DepthSorter } from "./sorting.js";
import fragmentShader from "./splat.frag.glsl";
import vertexShader from "./splat.vert.glsl";

/** @typedef {import("./pinhole.js").Pinhole} Pinhole */
/** @typedef {"colour" | "depth" | "uncertainty"} Shading */

const PER_ROW = 512; // Gaussians: 1536 texels, narrower than any WebGL 2 texture limit
export const DEPTH_RANGE_M = [0.3, 8]; // of the shading, as of the page's depth image
export const SIGMA_RANGE_M = [0.003, 0.3]; // of the shading by the largest standard deviation

export class Splats {
  constructor() {
    this.records = new Float32Array(0);
    this.count = 0;
    this.sorter = new DepthSorter();
    /** @type {[number, number]} */
    this.heights = [-Infinity, Infinity]; // only Gaussians between are drawn (m, map frame)
    this._geometry = new InstancedBufferGeometry();
    this._geometry.setAttribute("corner", new BufferAttribute(new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), 2));
    this._geometry.setIndex([0, 1, 2, 2, 1, 3]);
    this._geometry.instanceCount = 0;
    this._material = new RawShaderMaterial({
      glslVersion: GLSL3, vertexShader, fragmentShader, depthTest: false, depthWrite: false, transparent: true,
      blending: CustomBlending, blendSrc: OneFactor, blendDst: OneMinusSrcAlphaFactor,
      uniforms: {
        gaussians: { value: null }, perRow: { value: PER_ROW }, size: { value: new Vector2() }, shading: { value: 0 },
        range: { value: new Vector2() },
      },
    });
    this.mesh = new Mesh(this._geometry, this._material);
    this.mesh.frustumCulled = false; // the sorter culls
    this.mesh.renderOrder = 1;
  }

  /**
   * Replace all Gaussians.
   * @param {Uint32Array} words [count * WORDS], see codec.js
   */
  set(words) {
    this.count = words.length / WORDS;
    const rows = Math.max(Math.ceil(this.count / PER_ROW), 1);
    const data = new Uint32Array(rows * PER_ROW * WORDS);
    data.set(words);
    this.records = new Float32Array(data.buffer);
    const old = this._material.uniforms.gaussians.value;
    const texture = new DataTexture(data, PER_ROW * 3, rows, RGBAIntegerFormat, UnsignedIntType);
    texture.internalFormat = "RGBA32UI";
    texture.needsUpdate = true;
    this._material.uniforms.gaussians.value = texture;
    old?.dispose();
  }

  /** @param {Shading} shading */
  shade(shading) {
    const u = this._material.uniforms;
    u.shading.value = { colour: 0, depth: 1, uncertainty: 2 }[shading];
    if (shading === "depth") u.range.value.set(...DEPTH_RANGE_M);
    if (shading === "uncertainty") u.range.value.set(Math.log(SIGMA_RANGE_M[0]), Math.log(SIGMA_RANGE_M[1]));
  }

  /** Sort for a camera; call it before each frame with another camera or other Gaussians. @param {Pinhole} camera */
  prepare(camera) {
    this.sorter.sort(this.records, this.count, camera, this.heights);
    const { order, visible } = this.sorter;
    let attribute = /** @type {InstancedBufferAttribute | undefined} */ (this._geometry.getAttribute("order"));
    if (attribute?.array !== order) {
      if (attribute) this._geometry.dispose(); // its buffers are made anew, with the longer order
      attribute = new InstancedBufferAttribute(order, 1);
      attribute.setUsage(DynamicDrawUsage);
      this._geometry.setAttribute("order", attribute);
    }
    attribute.clearUpdateRanges();
    attribute.addUpdateRange(0, visible);
    attribute.needsUpdate = true;
    this._geometry.instanceCount = visible;
    this.mesh.visible = visible > 0;
    this._material.uniforms.size.value.set(camera.width, camera.height);
  }

  dispose() {
    this._geometry.dispose();
    this._material.uniforms.gaussians.value?.dispose();
    this._material.dispose();
  }
}

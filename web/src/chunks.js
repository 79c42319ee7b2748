// The Gaussians that are shown: chunks of the index at their levels of detail, fetched, placed and put together.
import { WORDS, decode, place } from "./codec.js";
import { Gone, message } from "./feed.js";
import { chooseLevels } from "./levels.js";

/**
 * @typedef {import("./levels.js").Chunk} Chunk
 * @typedef {{revision: number, cell_m: number, T: string, packed: import("./codec.js").PackedGaussians, words: Uint32Array}} Shown
 */

const AT_ONCE = 3; // requests: browsers open six connections per server, and two are event streams
const RETRY_MS = 2000;

export class ChunkStore {
  /**
   * @param {{chunk: (chunk: Chunk, cell_m: number, producer: string) => Promise<Uint8Array>, refresh: () => void}} feed
   * @param {() => void} changed called when `assemble` would give something else
   * @param {(text: string) => void} failed called with the reason why a chunk cannot be shown
   */
  constructor(feed, changed, failed) {
    this.feed = feed;
    this._changed = changed;
    this._failed = failed;
    /** @type {Map<number, Chunk>} */
    this.index = new Map();
    /** @type {Map<number, Shown>} */
    this.shown = new Map();
    /** @type {Map<number, import("./levels.js").Level>} */
    this._wanted = new Map();
    this._busy = new Set();
    this._producer = "";
  }

  get count() { return [...this.shown.values()].reduce((sum, s) => sum + s.packed.count, 0); }

  /** Whether all wanted chunks are shown at their level and revision. */
  get complete() { return !this._busy.size && ![...this._wanted.keys()].some((anchor) => this._due(anchor)); }

  /** @param {import("./feed.js").MapIndex} index */
  update(index) {
    if (index.producer !== this._producer) { this.shown.clear(); this._changed(); }
    this._producer = index.producer;
    this.index = new Map(index.chunks.map((chunk) => [chunk.anchor, chunk]));
    for (const [anchor, shown] of this.shown) {
      const chunk = this.index.get(anchor);
      if (!chunk) { this.shown.delete(anchor); this._changed(); } else if (String(chunk.T_map_anchor) !== shown.T) this._show(chunk, shown.revision, shown.cell_m, shown.packed);
    }
  }

  /**
   * Choose the levels of detail for a viewpoint, and fetch what is missing.
   * @param {ArrayLike<number>} eye map frame, m @param {number} focalPx @param {number} budget number of Gaussians
   */
  choose(eye, focalPx, budget) {
    this._wanted = chooseLevels([...this.index.values()], eye, focalPx, budget);
    for (const anchor of this.shown.keys()) {
      if (!this._wanted.has(anchor)) { this.shown.delete(anchor); this._changed(); }
    }
    this._fetchDue();
  }

  /** Fetch nothing more. */
  close() {
    this._wanted = new Map();
    this.index = new Map();
  }

  /** Return the records of all Gaussians, [count * WORDS]. @returns {Uint32Array} */
  assemble() {
    const all = new Uint32Array(this.count * WORDS);
    let at = 0;
    for (const { words } of this.shown.values()) { all.set(words, at); at += words.length; }
    return all;
  }

  /** @param {number} anchor whether what is shown differs from what is wanted */
  _due(anchor) {
    const chunk = this.index.get(anchor), level = this._wanted.get(anchor), shown = this.shown.get(anchor);
    return chunk && level && !(shown && shown.revision === chunk.revision && shown.cell_m === level.cell_m);
  }

  _fetchDue() {
    for (const anchor of this._wanted.keys()) { // nearest first
      if (this._busy.size >= AT_ONCE) return;
      if (!this._busy.has(anchor) && this._due(anchor)) this._fetch(anchor);
    }
  }

  /** @param {number} anchor */
  async _fetch(anchor) {
    const chunk = /** @type {Chunk} */ (this.index.get(anchor)), producer = this._producer;
    const { cell_m } = /** @type {import("./levels.js").Level} */ (this._wanted.get(anchor));
    this._busy.add(anchor);
    try {
      const packed = await decode(await this.feed.chunk(chunk, cell_m, producer));
      const newest = this.index.get(anchor); // its pose may have changed meanwhile
      if (newest && producer === this._producer && this._wanted.has(anchor)) this._show(newest, chunk.revision, cell_m, packed);
    } catch (error) {
      if (error instanceof Gone) this.feed.refresh();
      else this._failed(message(error));
      await new Promise((resolve) => setTimeout(resolve, RETRY_MS)); // others go on meanwhile
    } finally {
      this._busy.delete(anchor);
    }
    this._fetchDue();
  }

  /** @param {Chunk} chunk @param {number} revision @param {number} cell_m @param {import("./codec.js").PackedGaussians} packed */
  _show(chunk, revision, cell_m, packed) {
    this.shown.set(chunk.anchor, { revision, cell_m, T: String(chunk.T_map_anchor), packed, words: place(packed, chunk.T_map_anchor) });
    this._changed();
  }
}

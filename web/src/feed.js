// Where the map comes from: a page's server (requests and server-sent events), or a document that has it inside.

/**
 * @typedef {import("./levels.js").Chunk} Chunk
 * @typedef {{id: string, T_map_camera: number[]}} Keyframe
 * @typedef {{producer: string, revision: number, chunks: Chunk[], keyframes: Keyframe[],
 *   camera: {width: number, height: number, K: number[]} | null, note?: string,
 *   limited?: {coarsened: number, left_out: number, budget_mb: number}, path?: number[], data?: Record<string, string>}} MapIndex
 * @typedef {{index: (index: MapIndex) => void, robot: (robot: any) => void, path: (path: number[]) => void,
 *   scan: (scan: {T_map_lidar: number[], points: number[][]}) => void,
 *   plan: (image: HTMLImageElement, place: any) => void, connection: (text: string) => void}} FeedEvents
 */

const RETRY_MS = 2000;
const WIDEST_PX = 1280; // of a render by the server

/** Error: the server has this revision no more; a newer index has another one. */
export class Gone extends Error {}

/** The routes `map3d` and `events` of a page's server. */
export class LiveFeed {
  /**
   * @param {string} base prefix of the routes, "" = relative to the document
   * @param {boolean} saved the map does not change: no events are asked for
   * @param {FeedEvents} events
   */
  constructor(base, saved, events) {
    this._base = base && !base.endsWith("/") ? `${base}/` : base;
    this._events = events;
    this._closed = false;
    this._asking = false;
    this._again = false;
    this._saved = saved;
    this._revision = -1;
    /** @type {EventSource | null} */
    this._source = null;
    if (saved) this.refresh();
    else this._listen();
  }

  get canRender() { return true; }

  /** Get the index, once more after the request that is under way. */
  async refresh() {
    if (this._asking) { this._again = true; return; }
    this._asking = true;
    try {
      const reply = await fetch(`${this._base}map3d`);
      if (!reply.ok) throw new Error(await errorOf(reply));
      const index = await reply.json();
      if (this._closed) return;
      this._events.index(index);
      // A saved map has no events, but gets its coarser levels after the start.
      if (this._saved && index.revision !== this._revision) setTimeout(() => this.refresh(), RETRY_MS);
      this._revision = index.revision;
    } catch (error) {
      this._events.connection(`no map: ${message(error)}`);
      if (!this._closed) setTimeout(() => this.refresh(), RETRY_MS);
    } finally {
      this._asking = false;
    }
    if (this._again && !this._closed) { this._again = false; this.refresh(); }
  }

  /**
   * Return the bytes of a chunk.
   * @param {Chunk} chunk @param {number} cell_m of its level @param {string} producer of the index
   * @returns {Promise<Uint8Array>}
   * @throws {Gone} this revision is gone
   */
  async chunk(chunk, cell_m, producer) {
    const query = `producer=${encodeURIComponent(producer)}&revision=${chunk.revision}&cell_m=${cell_m}`;
    const reply = await fetch(`${this._base}map3d/chunk/${chunk.anchor}?${query}`);
    if (reply.status === 404) throw new Gone(await errorOf(reply));
    if (!reply.ok) throw new Error(await errorOf(reply));
    return new Uint8Array(await reply.arrayBuffer());
  }

  /** URL of a keyframe's image. @param {string} id @param {number} [width] px, of a thumbnail */
  keyframeURL(id, width) { return `${this._base}map3d/keyframe/${id}${width ? `?width=${width}` : ""}`; }

  /** URL of a render by the server. @param {import("./pinhole.js").Pinhole} c */
  renderURL(c) {
    const s = Math.min(1, WIDEST_PX / c.width, WIDEST_PX / c.height), size = [c.width, c.height].map((v) => Math.round(v * s));
    return `${this._base}map3d/render?T=${c.T_map_camera.join(",")}&width=${size[0]}&height=${size[1]}&focal_px=${c.fx * s}`;
  }

  close() {
    this._closed = true;
    this._source?.close();
  }

  _listen() {
    const source = this._source = new EventSource(`${this._base}events?scan=1`), events = this._events;
    /** @param {string} kind @param {(data: any) => void} take */
    const on = (kind, take) => source.addEventListener(kind, (e) => take(JSON.parse(e.data)));
    source.onopen = () => { events.connection(""); this.refresh(); };
    source.onerror = () => events.connection("not connected"); // the browser reconnects by itself
    on("map3d", () => this.refresh());
    on("robot", (robot) => events.robot(robot));
    on("path", (path) => events.path(path));
    on("scan3d", (scan) => scan && events.scan(scan));
    on("picture", (p) => { if (p.name === "map") this._plan(p); });
  }

  /** @param {any} place number, x_m, y_m, cell_m, width, height of the picture of the grid */
  _plan(place) {
    const image = new Image();
    image.onload = () => this._events.plan(image, place);
    image.src = `${this._base}picture/map?${place.number}`;
  }
}

/** A map inside the document: no requests. */
export class EmbeddedFeed {
  /** @param {MapIndex} index with `data`: base64 of the chunks' bytes by anchor @param {FeedEvents} events */
  constructor(index, events) {
    this._data = index.data ?? {};
    queueMicrotask(() => {
      events.index(index);
      if (index.path) events.path(index.path);
    });
  }

  get canRender() { return false; }

  refresh() {}

  /** @param {Chunk} chunk @returns {Promise<Uint8Array>} */
  async chunk(chunk) {
    const text = this._data[chunk.anchor];
    if (text === undefined) throw new Gone(`chunk ${chunk.anchor} is not in this document`);
    return Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  }

  /** @param {string} _id @param {number} [_width] */
  keyframeURL(_id, _width) { return ""; }

  /** @param {import("./pinhole.js").Pinhole} _camera */
  renderURL(_camera) { return ""; }

  close() {}
}

/** @param {Response} reply @returns {Promise<string>} the server's reason */
async function errorOf(reply) {
  const text = await reply.text();
  try { return JSON.parse(text).error ?? text; } catch { return `${reply.status} ${reply.statusText}`; }
}

/** @param {unknown} error */
export const message = (error) => (error instanceof Error ? error.message : String(error));

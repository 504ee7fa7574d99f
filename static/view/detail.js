// Finer parts of a large photo: if the user zooms in beyond the resolution of the loaded level, the visible tiles are fetched from a finer
// level and drawn over it with the same camera.

import { Decoder } from '../decode/start.js';
import { drawnOver } from '../draw/backends.js';

/** @import { Scene, SceneHead } from '../decode/scene.js' */
/** @import { Mode } from '../draw/backends.js' */
/** @import { WebGlRenderer } from '../draw/webgl.js' */
/** @import { WebGpuRenderer } from '../draw/webgpu.js' */
/** @import { Frame } from './camera.js' */

/** @typedef {{x: number, y: number, w: number, h: number}} Rect in pixels of the full-size photo */

/** Screen pixels per pixel of the level from which a finer level is fetched. */
const MIN_ENLARGEMENT = 1.2;
/** Margin around the visible part, as a share of it, because the camera moves. */
const MARGIN = 0.2;
/** Corners are multiples of this many pixels of the level, so that parts can be cached. */
const GRID_PX = 256;
/** Most pixels of a part; beyond that, a coarser level is used. */
const MAX_PIXELS = 12_000_000;
/** Time without changes before a part is requested, ms. */
const WAIT_MS = 180;
const MAX_LEVEL = 3;

/**
 * The part to load for the visible area, or null if the loaded level is as fine as the screen.
 * @param {{width: number, height: number}} photo full size
 * @param {{width: number}} loaded size of the loaded level
 * @param {Frame} frame
 * @param {{width: number, height: number}} canvas size in screen pixels
 * @returns {{level: number, rect: Rect, sight: Rect} | null} `sight`: the visible area, which the part must cover
 */
export function visiblePart(photo, loaded, frame, canvas) {
  const shown = canvas.width * frame.scale;
  if (shown < MIN_ENLARGEMENT * loaded.width || loaded.width >= photo.width) return null;
  const each = photo.width / shown;
  const half = { x: (canvas.width * each) / 2, y: (canvas.height * each) / 2 };
  const around = (/** @type {number} */ by, /** @type {number} */ step) => {
    const range = (/** @type {number} */ middle, /** @type {number} */ reach, /** @type {number} */ length) => {
      const from = Math.max(0, Math.floor((middle - reach * by) / step) * step);
      const to = Math.min(length, Math.ceil((middle + reach * by) / step) * step);
      return [from, Math.max(1, to - from)];
    };
    const [x, w] = range(frame.x * photo.width, half.x, photo.width);
    const [y, h] = range(frame.y * photo.height, half.y, photo.height);
    return { x, y, w, h };
  };
  const finer = Math.ceil(Math.log2(photo.width / loaded.width) - 0.1);
  let level = Math.max(0, Math.min(MAX_LEVEL, Math.floor(Math.log2(each) + 0.2)));
  for (; level < finer; level++) {
    const rect = around(1 + MARGIN, GRID_PX << level);
    if (rect.w * rect.h <= MAX_PIXELS * 4 ** level) return { level, rect, sight: around(1, 1) };
  }
  return null;
}

/**
 * Address of a part, derived from the container's address; null if no server provides parts for it.
 * @param {string} atlas
 * @param {{level: number, rect: Rect}} part
 */
export function partAddress(atlas, { level, rect: { x, y, w, h } }) {
  const [path, query] = atlas.split('#')[0].split('?');
  if (!path.endsWith('/atlas')) return null;
  const parts = new URLSearchParams(query);
  parts.delete('fit');
  parts.set('level', String(level));
  parts.set('region', [x, y, w, h].join(','));
  return `${path}?${parts.toString().replaceAll('%2C', ',')}`;
}

/**
 * @param {Rect} a
 * @param {Rect} b
 */
const covers = (a, b) => a.x <= b.x && a.y <= b.y && a.x + a.w >= b.x + b.w && a.y + a.h >= b.y + b.h;

/** @typedef {{level: number, rect: Rect, canvas: HTMLCanvasElement, renderer: WebGpuRenderer | WebGlRenderer}} Part a drawn part */
/**
 * The loaded level: its container's address, the backend and its largest texture, the photo's full size, the head of the level, and a
 * callback for when the drawn part changes.
 * @typedef {{atlas: string, mode: Mode, side: number, photo: {width: number, height: number}, loaded: SceneHead, changed: () => void}} DetailOptions
 */

export class Detail {
  #options;
  /** @type {Part | null} */
  #shown = null;
  /** @type {{level: number, rect: Rect, worker: Decoder | null, timer: ReturnType<typeof setTimeout>} | null} */
  #loading = null;
  #failed = false;
  #disposed = false;

  /** @param {DetailOptions} options */
  constructor(options) {
    this.#options = options;
  }

  /** The part drawn over the loaded level, or null. */
  get shown() {
    return this.#shown;
  }

  /**
   * Loads the part for the visible area if it is missing.
   * @param {Frame} frame
   * @param {{width: number, height: number}} canvas size in screen pixels
   */
  update(frame, canvas) {
    const wanted = this.#failed ? null : visiblePart(this.#options.photo, this.#options.loaded, frame, canvas);
    if (!wanted) return this.#clear();
    const suffices = (/** @type {{level: number, rect: Rect} | null} */ part) =>
      part !== null && part.level <= wanted.level && covers(part.rect, wanted.sight);
    if (suffices(this.#shown) || suffices(this.#loading)) return;
    this.#cancel();
    const { level, rect } = wanted;
    this.#loading = { level, rect, worker: null, timer: setTimeout(() => this.#load(), WAIT_MS) };
  }

  dispose() {
    this.#disposed = true;
    this.#clear();
  }

  #cancel() {
    clearTimeout(this.#loading?.timer);
    this.#loading?.worker?.terminate();
    this.#loading = null;
  }

  #clear() {
    this.#cancel();
    this.#show(null);
  }

  #load() {
    const part = this.#loading;
    const url = part && partAddress(this.#options.atlas, part);
    if (!part || !url) return;
    part.worker = new Decoder();
    part.worker.onmessage = async ({ data }) => {
      if (data.type === 'error') return this.#fail();
      if (data.type !== 'scene' || this.#loading !== part) return;
      part.worker?.terminate();
      try {
        const { level, rect } = part;
        const drawn = await drawnOver(this.#options.mode, data.scene, () => this.#fail());
        if (this.#disposed || this.#loading !== part) return drawn.renderer.dispose();
        this.#loading = null;
        this.#show({ level, rect, ...drawn });
      } catch {
        this.#fail();
      }
    };
    part.worker.onerror = () => this.#fail();
    part.worker.postMessage({ url: new URL(url, document.baseURI).href, side: this.#options.side, bare: true });
  }

  /** Stops loading parts after a failure; the loaded level stays visible. */
  #fail() {
    this.#failed = true;
    this.#clear();
  }

  /** @param {Part | null} next */
  #show(next) {
    if (this.#shown === next) return;
    const old = this.#shown;
    this.#shown = next;
    this.#options.changed();
    old?.renderer.dispose();
  }
}

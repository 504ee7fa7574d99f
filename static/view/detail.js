// Finer parts of a large photo: where one looks closer than the loaded level has pixels, the tiles in sight are fetched from a finer
// one, and drawn over it with the same camera.

import { Decoder } from '../decode/start.js';
import { drawnOver } from '../draw/backends.js';

/** @import { Scene, SceneHead } from '../decode/scene.js' */
/** @import { Mode } from '../draw/backends.js' */
/** @import { WebGlRenderer } from '../draw/webgl.js' */
/** @import { WebGpuRenderer } from '../draw/webgpu.js' */
/** @import { Frame } from './camera.js' */

/** @typedef {{x: number, y: number, w: number, h: number}} Rect in pixels of the photo at its own size */

/** Pixels of the screen for one of the level, from which on a finer one is fetched. */
const COARSE = 1.2;
/** Margin around what is in sight, as a share of it, since nobody stands still. */
const MARGIN = 0.2;
/** Corners are whole multiples of so many pixels of the level, so that parts can be kept. */
const STEP = 256;
/** Most pixels of a part; beyond that a coarser level. */
const MOST_PIXELS = 12_000_000;
/** How long nothing must have changed before a part is asked for, ms. */
const WAIT_MS = 180;
const LEVELS = 3;

/**
 * The part that is wanted for what is in sight, or null where the loaded level is as fine as the screen.
 * @param {{width: number, height: number}} photo at its own size
 * @param {{width: number}} loaded of the level at hand
 * @param {Frame} frame
 * @param {{width: number, height: number}} canvas pixels of the screen
 * @returns {{level: number, rect: Rect, sight: Rect} | null} `sight` is what the part must cover
 */
export function wantedPart(photo, loaded, frame, canvas) {
  const shown = canvas.width * frame.scale;
  if (shown < COARSE * loaded.width || loaded.width >= photo.width) return null;
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
  let level = Math.max(0, Math.min(LEVELS, Math.floor(Math.log2(each) + 0.2)));
  for (; level < finer; level++) {
    const rect = around(1 + MARGIN, STEP << level);
    if (rect.w * rect.h <= MOST_PIXELS * 4 ** level) return { level, rect, sight: around(1, 1) };
  }
  return null;
}

/**
 * Address of a part beside that of a container, or null where no server has any.
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

/** @typedef {{level: number, rect: Rect, canvas: HTMLCanvasElement, renderer: WebGpuRenderer | WebGlRenderer}} Part one that is drawn */
/**
 * What parts are of: address of the container at hand, what draws it and the largest texture of that, the photo's own size, the head of
 * the level at hand, and what to call when there is another part to draw.
 * @typedef {{atlas: string, mode: Mode, side: number, photo: {width: number, height: number}, loaded: SceneHead, changed: () => void}} Whole
 */

export class Detail {
  #whole;
  /** @type {Part | null} */
  #shown = null;
  /** @type {{level: number, rect: Rect, worker: Decoder | null, timer: ReturnType<typeof setTimeout>} | null} */
  #coming = null;
  #refused = false;
  #disposed = false;

  /** @param {Whole} whole */
  constructor(whole) {
    this.#whole = whole;
  }

  /** What is drawn over the level at hand, or null. */
  get shown() {
    return this.#shown;
  }

  /**
   * Sees to what is in sight now.
   * @param {Frame} frame
   * @param {{width: number, height: number}} canvas pixels of the screen
   */
  look(frame, canvas) {
    const wanted = this.#refused ? null : wantedPart(this.#whole.photo, this.#whole.loaded, frame, canvas);
    if (!wanted) return this.#forget();
    const enough = (/** @type {{level: number, rect: Rect} | null} */ part) =>
      part !== null && part.level <= wanted.level && covers(part.rect, wanted.sight);
    if (enough(this.#shown) || enough(this.#coming)) return;
    this.#cancel();
    const { level, rect } = wanted;
    this.#coming = { level, rect, worker: null, timer: setTimeout(() => this.#load(), WAIT_MS) };
  }

  dispose() {
    this.#disposed = true;
    this.#forget();
  }

  #cancel() {
    clearTimeout(this.#coming?.timer);
    this.#coming?.worker?.terminate();
    this.#coming = null;
  }

  #forget() {
    this.#cancel();
    this.#show(null);
  }

  #load() {
    const part = this.#coming;
    const url = part && partAddress(this.#whole.atlas, part);
    if (!part || !url) return;
    part.worker = new Decoder();
    part.worker.onmessage = async ({ data }) => {
      if (data.type === 'error') return this.#refuse();
      if (data.type !== 'scene' || this.#coming !== part) return;
      part.worker?.terminate();
      try {
        const { level, rect } = part;
        const made = await drawnOver(this.#whole.mode, data.scene, () => this.#refuse());
        if (this.#disposed || this.#coming !== part) return made.renderer.dispose();
        this.#coming = null;
        this.#show({ level, rect, ...made });
      } catch {
        this.#refuse();
      }
    };
    part.worker.onerror = () => this.#refuse();
    part.worker.postMessage({ url: new URL(url, document.baseURI).href, side: this.#whole.side, bare: true });
  }

  /** What cannot be had is not asked for again: the level at hand is shown as large. */
  #refuse() {
    this.#refused = true;
    this.#forget();
  }

  /** @param {Part | null} next */
  #show(next) {
    if (this.#shown === next) return;
    const old = this.#shown;
    this.#shown = next;
    this.#whole.changed();
    old?.renderer.dispose();
  }
}

// A band of a container's tiles, decoded by an instance of the decoder.

import { hasDeepStacks } from '../draw/deep-stacks.js';
import { inHalves, premultipliedHalves } from '../draw/half-float.js';
import { Decoder } from './decoder.js';

/** @import { Piece } from '../draw/border.js' */
/** @import { Layers, Picture, SceneHead } from './scene.js' */

/**
 * Input of a band: the container, the range of rows of tiles (`end` is exclusive), the photo's rows from `top` on that these depend on, and
 * the picture of hidden colours if there is one.
 * @typedef {{scene: SceneHead, bytes: Uint8Array, first: number, end: number, top: number, photo: Picture, hidden: Picture | null}} BandJob
 */
/** @typedef {{pieces: Uint32Array, width: number, height: number}} StripJob arguments of `Decoder.strip` */

export class Band {
  /** @type {Decoder | null} */
  #decoder = null;
  /** @type {Layers | null} */
  #layers = null;

  /** @param {WebAssembly.Module} module */
  constructor(module) {
    this.module = module;
  }

  /**
   * @param {BandJob} job
   * @returns {Promise<Layers>}
   */
  async decode({ scene, bytes, first, end, top, photo, hidden }) {
    const decoder = await Decoder.of(this.module);
    decoder.open(bytes);
    decoder.picture('photo', photo, top);
    if (hidden) decoder.picture('hidden', hidden);
    this.#decoder = decoder;
    this.#layers = decoder.decode(scene, first, end);
    return this.#layers;
  }

  /**
   * Whether this band has deep stacks of soft texels. Call it after `decode`.
   * @param {{width: number, height: number, pieces: Piece[]}} job size of the photo, and pieces of this band's layers
   */
  async deep({ pieces, ...photo }) {
    if (!this.#decoder || !this.#layers) throw new Error('nothing was decoded');
    return hasDeepStacks(photo, this.#layers, this.#decoder.alpha, pieces);
  }

  /**
   * Strips of texture pages, as bytes or 16-bit floats. Call it after `decode`.
   * @param {{jobs: StripJob[], wide: boolean}} asked
   * @returns {Promise<{data: Uint8Array<ArrayBuffer> | Uint16Array<ArrayBuffer>}[]>}
   */
  async strips({ jobs, wide }) {
    const decoder = this.#decoder;
    if (!decoder) throw new Error('nothing was decoded');
    const halves = wide && jobs.length ? premultipliedHalves() : null;
    return jobs.map(({ pieces, width, height }) => {
      const bytes = decoder.strip(pieces, width, height, wide);
      return { data: halves ? inHalves(bytes, halves) : bytes };
    });
  }

  close() {
    this.#decoder = null;
  }
}

// A band of a container's tiles, decoded by an instance of the decoder.
import { Decoder } from './decoder.js';

/** @import { Layers, Picture, SceneHead } from './scene.js' */

/**
 * What a band is decoded from: the container, rows of tiles from `first` to before `end`, the photo's rows from `top` on that these
 * follow from, and the picture of hidden colours where there is one.
 * @typedef {{scene: SceneHead, bytes: Uint8Array, first: number, end: number, top: number, photo: Picture, hidden: Picture | null}} BandJob
 */
/** @typedef {{pieces: Uint32Array, width: number, height: number}} StripJob what `Decoder.strip` takes */

export class Band {
  /** @type {Decoder | null} */
  #decoder = null;

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
    return decoder.decode(scene, first, end);
  }

  /**
   * Strips of texture pages, after `decode`.
   * @param {StripJob[]} jobs
   * @returns {Promise<{data: Uint8Array<ArrayBuffer>}[]>}
   */
  async strips(jobs) {
    const decoder = this.#decoder;
    if (!decoder) throw new Error('nothing was decoded');
    return jobs.map(({ pieces, width, height }) => ({ data: decoder.strip(pieces, width, height) }));
  }

  close() {
    this.#decoder = null;
  }
}

// Decodes a container, or a band of its tiles, in an instance of decoder.wasm (crates/decoder). Pure: no page, no network. The caller
// decodes the pictures.

import { Instance } from './wasm-instance.js';

/** @import { Layers, SceneHead } from './scene.js' */

/** Numbers of crates/decoder's `Output`. */
const [NUMBERS, CLASSES, ALPHA, HIDDEN, STRIP] = [2, 3, 4, 5, 6];
/** Count of columns in the table of layers. */
const COLUMNS = 10;
/** Bytes of picture rows that are passed per call. */
const PICTURE_BYTES = 4 << 20;

export class Decoder {
  #instance;

  /** @param {WebAssembly.Module} module of decoder.wasm */
  static async of(module) {
    return new Decoder(await Instance.of(module));
  }

  /** @param {Instance} instance */
  constructor(instance) {
    this.#instance = instance;
  }

  /** Size of the instance's memory, bytes. */
  get memory() {
    return this.#instance.memory;
  }

  /**
   * Passes a whole container without zstd sections (unpack.js). The decoder ignores the bytes of its photo.
   * @param {Uint8Array} bytes
   */
  open(bytes) {
    this.#instance.hand(bytes);
    this.#instance.call('tmpi_open');
  }

  /**
   * Passes the photo, its rows from `top` on, or the picture of hidden colours.
   * @param {'photo' | 'hidden'} kind
   * @param {{width: number, height: number, data: Uint8Array | Uint8ClampedArray}} picture size of the whole picture, straight RGBA
   */
  picture(kind, { width, height, data }, top = 0) {
    const step = Math.max(1, Math.floor(PICTURE_BYTES / (width * 4))) * width * 4;
    for (let at = 0; at < data.length; at += step) {
      this.#instance.hand(data.subarray(at, at + step));
      this.#instance.call('tmpi_picture', kind === 'hidden' ? 1 : 0, width, height, top);
    }
  }

  /**
   * Decodes rows of tiles from `first` to `end`, exclusive.
   * @param {Pick<SceneHead, 'tileSize' | 'tileStride' | 'width'>} scene
   * @param {number} first
   * @param {number} end
   * @returns {Layers}
   * @throws {ContainerError}
   */
  decode({ tileSize, tileStride, width }, first, end) {
    this.#instance.call('tmpi_decode', first, end);
    const numbers = this.#numbers();
    const count = numbers.length / COLUMNS;
    const columns = width <= tileSize ? 1 : Math.ceil((width - tileSize) / tileStride) + 1;
    const table = Array.from({ length: COLUMNS }, (_, i) => numbers.subarray(i * count, (i + 1) * count));
    const [a, b, c, x, y, w, h, tile, visible, soft] = table;
    return {
      count,
      a: a.slice(),
      b: b.slice(),
      c: c.slice(),
      x: Uint32Array.from(x),
      y: Uint32Array.from(y),
      w: Uint32Array.from(w),
      h: Uint32Array.from(h),
      tileX: Uint32Array.from(tile, (t) => (t % columns) * tileStride),
      tileY: Uint32Array.from(tile, (t) => Math.floor(t / columns) * tileStride),
      visible: Uint32Array.from(visible),
      soft: Uint8Array.from(soft),
    };
  }

  /** Alphas of all texels, valid until the next call. */
  get alpha() {
    return this.#instance.output(ALPHA);
  }

  /** Copies of the classes, alphas and hidden colours of all texels, for tests. */
  texels() {
    return {
      classes: this.#instance.output(CLASSES).slice(),
      alpha: this.#instance.output(ALPHA).slice(),
      hidden: this.#instance.output(HIDDEN).slice(),
    };
  }

  /**
   * Fills a strip of a texture page.
   * @param {Uint32Array} pieces seven numbers each: layer, first column, first row, columns, rows, `mirrorFlags`, column in the strip
   * @param {number} width
   * @param {number} height
   * @param {boolean} straight
   * @returns {Uint8Array<ArrayBuffer>} RGBA, premultiplied unless `straight`, in a new buffer
   */
  strip(pieces, width, height, straight = false) {
    this.#instance.hand(new Uint8Array(pieces.buffer, pieces.byteOffset, pieces.byteLength));
    this.#instance.call('tmpi_strip', width, height, Number(straight));
    return new Uint8Array(this.#instance.output(STRIP));
  }

  #numbers() {
    // copied, because it may not be aligned to eight bytes
    return new Float64Array(this.#instance.output(NUMBERS).slice().buffer);
  }
}

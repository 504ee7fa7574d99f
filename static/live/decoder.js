// Reads and writes the messages of a room and computes its layers, in an instance of decoder.wasm (crates/live-decoder). Pure: no page, no
// network. The browser decodes video and sound.

import { compiledFrom } from '../decode/module.js';
import { Instance } from '../decode/wasm-instance.js';

/** @import { SceneHead } from '../decode/scene.js' */

/** Numbers of crates/live-decoder's `Output`. */
const [NUMBERS, DATA, TILES, LAYERS, CELLS, MESSAGE] = [2, 3, 4, 5, 6, 7];
/** Numbers per layer, and the layer count that marks a tile with unchanged layers. */
const COLUMNS = 9;
const UNCHANGED = 2 ** 32 - 1;
/** Browsers' names of the matrices of ITU-T H.273. @type {Record<number, string>} */
const MATRICES = Object.freeze({ 1: 'bt709', 6: 'smpte170m', 9: 'bt2020-ncl' });
/** Pixel formats, by the numbers of `Pixels`. */
export const PIXELS = Object.freeze({ I420: 0, NV12: 1, RGBA: 2 });

/**
 * The first message of a publisher or the server. `codec` and `sound` are WebCodecs codec strings; `sound` is empty without sound.
 * @typedef {{kind: 'hello', head: SceneHead, codec: string, sound: string, rate: number, channels: number, epoch: number}} Hello
 */
/** @typedef {{matrix: string, fullRange: boolean}} Colour how to interpret the samples of a video */
/**
 * `time` in µs by the publisher's clock; `layer`: temporal layer; `shown`: visible part of the coded picture.
 * @typedef {{kind: 'video', frame: number, time: number, key: boolean, layer: number, colour: Colour, shown: DOMRectInit,
 *   data: Uint8Array<ArrayBuffer>}} Video
 */
/** @typedef {{kind: 'sound', time: number, data: Uint8Array<ArrayBuffer>}} Sound */
/** @typedef {{kind: 'tiles', frame: number, changed: number}} Tiles `changed`: count of tiles that have been applied; those of a later frame wait for it */
/**
 * @typedef {{kind: 'statistics', frame: number, viewers: number, frames: number, videoBytes: number, geometryBytes: number, tiles: number,
 *   leftOut: number, skipped: number, forwardMs: number, geometryMs: number}} Statistics
 */
/** @typedef {{kind: 'bye', reason: string, again: boolean, cause: Cause}} Bye */
/** @typedef {'other' | 'left' | 'lost' | 'rejected' | 'full' | 'taken' | 'codec'} Cause why the server closes the connection (live.proto) */
/** @typedef {{kind: 'credit', frames: number, key: boolean}} Credit */
/** @typedef {{kind: 'other'}} Other not for this program */
/** @typedef {Hello | Video | Sound | Tiles | Statistics | Bye | Credit | Other} Message */

/** @typedef {{tile: number, layers: Float64Array[] | null}} ChangedTile `layers`: nine numbers each (crates/live-decoder), or null if unchanged */

/** In the order of their numbers in live.proto. @type {Cause[]} */
const CAUSES = ['other', 'left', 'lost', 'rejected', 'full', 'taken', 'codec'];

/** Compiles the module. */
export function compiled() {
  return compiledFrom(new URL('./decoder.wasm', import.meta.url));
}

export class RoomDecoder {
  #instance;

  /** @param {WebAssembly.Module} module of decoder.wasm */
  static async of(module) {
    return new RoomDecoder(await Instance.of(module));
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
   * Reads a message and applies its tiles, or keeps them until their frame comes.
   * @param {Uint8Array} bytes
   * @returns {Message}
   * @throws {ContainerError} if the message is malformed
   */
  read(bytes) {
    this.#instance.hand(bytes);
    const kind = this.#instance.call('tmpi_message');
    const n = this.#floats(NUMBERS);
    if (kind === 1) {
      const [width, height, tileSize, tileStride, fx, fy, cx, cy, x, y, z, rate, channels, epoch] = n;
      const [codec, sound] = this.#text(DATA).split('\n');
      const head = { width, height, tileSize, tileStride, intrinsics: { fx, fy, cx, cy }, viewBox: { x, y, z } };
      return { kind: 'hello', head, codec, sound, rate, channels, epoch };
    }
    if (kind === 2) {
      const colour = { matrix: MATRICES[n[4]] ?? 'bt709', fullRange: n[5] === 1 };
      const shown = { x: n[6], y: n[7], width: n[8], height: n[9] };
      return { kind: 'video', frame: n[0], time: n[1], key: n[2] === 1, layer: n[3], colour, shown, data: this.#copy(DATA) };
    }
    if (kind === 3 || kind === 4) return { kind: 'tiles', frame: n[0], changed: n[1] };
    if (kind === 5) return { kind: 'sound', time: n[0], data: this.#copy(DATA) };
    if (kind === 6) {
      const [frame, viewers, frames, videoBytes, geometryBytes, tiles, leftOut, skipped, forwardMs, geometryMs] = n;
      return { kind: 'statistics', frame, viewers, frames, videoBytes, geometryBytes, tiles, leftOut, skipped, forwardMs, geometryMs };
    }
    if (kind === 7) return { kind: 'bye', reason: this.#text(DATA), again: n[0] === 1, cause: CAUSES[n[1]] ?? 'other' };
    if (kind === 8) return { kind: 'credit', frames: n[0], key: n[1] === 1 };
    return { kind: 'other' };
  }

  /**
   * Sets the next frame, a picture of the room's size.
   * @param {number} format one of `PIXELS`
   * @param {Uint8Array | Uint8ClampedArray} bytes planes without gaps
   * @param {{frame: number, time: number}} [of] its number, and its capture time, µs by the publisher's clock
   */
  frame(format, bytes, { frame, time } = { frame: 0, time: 0 }) {
    this.#instance.hand(bytes);
    this.#instance.call('tmpi_frame', format, frame, time);
  }

  /**
   * Updates the layers to the latest frame and tiles. Returns the changed tiles in order, or none until every tile has arrived.
   * @returns {ChangedTile[]}
   */
  layers() {
    if (!this.#instance.call('tmpi_layers')) return [];
    const tiles = new Uint32Array(this.#copy(TILES).buffer);
    const rows = this.#floats(LAYERS);
    const out = [];
    let at = 0;
    for (let i = 0; i < tiles.length; i += 2) {
      const count = tiles[i + 1];
      if (count === UNCHANGED) out.push({ tile: tiles[i], layers: null });
      else {
        out.push({
          tile: tiles[i],
          layers: Array.from({ length: count }, (_, k) => rows.subarray(at + k * COLUMNS, at + (k + 1) * COLUMNS)),
        });
        at += count * COLUMNS;
      }
    }
    return out;
  }

  /**
   * Computes the texels of layers, and the means along the frame's borders.
   * @param {Uint32Array} layers two numbers each: the tile, and the layer's index in the tile
   * @param {number} columns of the means (crates/core's `BorderColours::strips`); 0 for none
   * @param {ArrayBuffer} [scratch] a buffer to reuse if it is large enough
   * @returns {Uint8Array<ArrayBuffer>} premultiplied RGBA, row by row, one layer after another, then the means
   */
  cells(layers, columns, scratch) {
    this.#instance.hand(new Uint8Array(layers.buffer, layers.byteOffset, layers.byteLength));
    this.#instance.call('tmpi_cells', columns);
    const texels = this.#instance.output(CELLS);
    const out = scratch && scratch.byteLength >= texels.length ? new Uint8Array(scratch, 0, texels.length) : new Uint8Array(texels.length);
    out.set(texels);
    return out;
  }

  /**
   * @param {{width: number, height: number, codec: string, sound?: string, rate?: number, channels?: number, fovX?: number}} hello
   */
  writeHello({ width, height, codec, sound = '', rate = 0, channels = 0, fovX = 0 }) {
    this.#instance.hand(new TextEncoder().encode(`${codec}\n${sound}`));
    return this.#written('tmpi_write_hello', width, height, fovX, rate, channels);
  }

  /** @param {{frame: number, time: number, key: boolean, layer?: number, data: Uint8Array}} video */
  writeVideo({ frame, time, key, layer = 0, data }) {
    this.#instance.hand(data);
    return this.#written('tmpi_write_video', frame, time, Number(key), layer);
  }

  /** @param {{time: number, data: Uint8Array}} sound */
  writeSound({ time, data }) {
    this.#instance.hand(data);
    return this.#written('tmpi_write_sound', time);
  }

  /** @param {string} reason */
  writeBye(reason) {
    this.#instance.hand(new TextEncoder().encode(reason));
    return this.#written('tmpi_write_bye');
  }

  /**
   * @param {string} name
   * @param {number[]} args
   */
  #written(name, ...args) {
    this.#instance.call(name, ...args);
    return this.#copy(MESSAGE);
  }

  /** @param {number} what */
  #copy(what) {
    return this.#instance.output(what).slice();
  }

  /** @param {number} what */
  #text(what) {
    return new TextDecoder().decode(this.#instance.output(what));
  }

  /** @param {number} what */
  #floats(what) {
    // copied, because it may not be aligned to eight bytes
    return new Float64Array(this.#copy(what).buffer);
  }
}

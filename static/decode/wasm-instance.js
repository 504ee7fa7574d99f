// Calls the functions of a WebAssembly module (crates/decoder, crates/live-decoder, crates/unpacker).

import { ContainerError } from './head.js';

/** Outputs that every module has. */
const [TEXT, PANIC] = [0, 1];

/** @typedef {Record<string, (...args: number[]) => number> & {memory: WebAssembly.Memory}} Exports */

export class Instance {
  #exports;

  /** @param {WebAssembly.Module} module */
  static async of(module) {
    return new Instance(await WebAssembly.instantiate(module, {}));
  }

  /** @param {WebAssembly.Instance} instance a new one */
  constructor(instance) {
    this.#exports = /** @type {Exports} */ (/** @type {unknown} */ (instance.exports));
  }

  /** Size of the instance's memory, bytes. */
  get memory() {
    return this.#exports.memory.buffer.byteLength;
  }

  /**
   * Passes bytes to the next call.
   * @param {Uint8Array | Uint8ClampedArray} bytes
   */
  hand(bytes) {
    const at = this.#guarded('tmpi_room', [bytes.length]);
    new Uint8Array(this.#exports.memory.buffer).set(bytes, at >>> 0);
  }

  /**
   * @param {string} name
   * @param {number[]} args
   * @returns {number} result of the call
   * @throws {ContainerError} with the message of a failed call
   */
  call(name, ...args) {
    const given = this.#guarded(name, args);
    if (given < 0) throw new ContainerError(new TextDecoder().decode(this.output(TEXT)));
    return given;
  }

  /**
   * An output, valid until the next call.
   * @param {number} what
   */
  output(what) {
    const { tmpi_output, tmpi_output_length, memory } = this.#exports;
    return new Uint8Array(memory.buffer, tmpi_output(what) >>> 0, tmpi_output_length(what) >>> 0);
  }

  /**
   * Calls a function; after a panic or a failed allocation, throws its message. The instance is then unusable.
   * @param {string} name
   * @param {number[]} args
   */
  #guarded(name, args) {
    try {
      return this.#exports[name](...args);
    } catch (error) {
      const text = new TextDecoder().decode(this.output(PANIC));
      throw new Error(`the decoder failed: ${text || error.message}`);
    }
  }
}

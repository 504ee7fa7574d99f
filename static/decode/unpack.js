// Unpacks zstd sections: the decoder has no zstd, and few containers have such a section.

import { Instance } from './instance.js';
import { compiledFrom } from './module.js';

/** The container, by the number of crates/unpacker's `Output`. */
const CONTAINER = 2;

/** The compiled unpacker. */
export function unpacker() {
  return compiledFrom(new URL('./unpacker.wasm', import.meta.url));
}

/**
 * The container with its zstd sections unpacked.
 * @param {WebAssembly.Module} module of `unpacker`
 * @param {Uint8Array} bytes
 * @returns {Promise<Uint8Array<ArrayBuffer>>}
 * @throws {ContainerError}
 */
export async function unpacked(module, bytes) {
  const instance = await Instance.of(module);
  instance.hand(bytes);
  instance.call('tmpi_unpack');
  return instance.output(CONTAINER).slice();
}

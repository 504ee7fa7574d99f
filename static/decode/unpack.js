// Decompresses zstd sections. It is a separate module because few containers have such sections.

import { compiledFrom } from './module.js';
import { Instance } from './wasm-instance.js';

/** Number of the container in crates/unpacker's `Output`. */
const CONTAINER = 2;

/** Compiles the unpacker. */
export function unpacker() {
  return compiledFrom(new URL('./unpacker.wasm', import.meta.url));
}

/**
 * Decompresses the zstd sections of a container.
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

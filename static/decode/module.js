// Fetches WebAssembly modules and compiles them while they arrive.

/** Error message for site owners whose content security policy forbids WebAssembly. */
export const REFUSED = "The page's content security policy forbids WebAssembly: add 'wasm-unsafe-eval' to its script-src.";

/** Compiles the decoder. */
export function compiled() {
  return compiledFrom(new URL('./decoder.wasm', import.meta.url));
}

/**
 * @param {URL} address
 * @returns {Promise<WebAssembly.Module>}
 */
export async function compiledFrom(address) {
  const response = await fetch(address);
  if (!response.ok) throw new Error('the decoder cannot be loaded');
  try {
    // streaming requires the media type; other servers and data: URLs load the whole module first
    if (response.headers.get('content-type') === 'application/wasm') return await WebAssembly.compileStreaming(response);
    return await WebAssembly.compile(await response.arrayBuffer());
  } catch (error) {
    if (error instanceof WebAssembly.CompileError && /unsafe-eval|Content Security Policy|disallowed|blocked by CSP/i.test(error.message)) {
      throw new Error(REFUSED);
    }
    throw error;
  }
}

// Fetches and decodes a container, in a worker (worker.js) or on the page's thread if workers are not available.
//
// Request: {url, photoOnly, side, bare}. `photoOnly`: stop after the photo; `side`: of the largest texture; `bare`: the scene is a part of
// another one, so it is not continued beyond its borders. Responses: {type: 'progress', received, total}, {type: 'head', …},
// {type: 'photo', blob}, {type: 'scene', scene}, {type: 'error', message}.
//
// Requests from another worker that runs this module: {band}, then {deep} and {strips}. Response: {type: 'done', value}.

import { assembled } from './assemble.js';
import { Band } from './band.js';
import { readHead } from './head.js';
import { compiled } from './module.js';
import { problemOf } from './problem.js';
import { startWorker } from './start.js';

/** @import { BandJob } from './band.js' */
/** @import { Head, PictureFile } from './head.js' */
/** @import { Layers, Picture } from './scene.js' */

/** @typedef {{url: string, photoOnly?: boolean, side?: number, bare?: boolean}} Wanted request to load a container */
/** @typedef {Parameters<Band['deep']>[0]} DeepJob */
/** @typedef {Parameters<Band['strips']>[0]} StripsJob */
/** @typedef {{band: BandJob & {module: WebAssembly.Module}} | {deep: DeepJob} | {strips: StripsJob}} Asked request from another worker */
/** @typedef {{onmessage: ((event: MessageEvent) => void) | null, postMessage: (message: unknown, options?: StructuredSerializeOptions) => void}} Port a worker's global scope or a message port */

/** Largest container, bytes. */
const MAX_BYTES = 512 * 1024 * 1024;
const POST_EVERY_MS = 100;
/** Pixels per band that justify another worker, and most bands. */
const BAND_PIXELS = 1_000_000;
const MAX_BANDS = 4;

/** A further worker could not be started from this one. */
class NoWorker extends Error {}

/** A band that another worker decodes; has the methods of `Band`. */
class RemoteBand {
  /** @param {WebAssembly.Module} module */
  constructor(module) {
    this.worker = startWorker(new URL('./worker.js', import.meta.url));
    this.module = module;
  }

  /**
   * @param {BandJob} job
   * @returns {Promise<Layers>}
   */
  decode(job) {
    // `cut` copies the rows of this band, so the buffer can be transferred
    return this.#ask({ band: { ...job, module: this.module } }, /** @type {ArrayBuffer} */ (job.photo.data.buffer));
  }

  /**
   * @param {DeepJob} job
   * @returns {Promise<boolean>}
   */
  deep(job) {
    return this.#ask({ deep: job });
  }

  /**
   * @param {StripsJob} asked
   * @returns {ReturnType<Band['strips']>}
   */
  strips(asked) {
    return this.#ask({ strips: asked });
  }

  /**
   * @template T
   * @param {Asked} message
   * @param {ArrayBuffer[]} transfer
   * @returns {Promise<T>}
   */
  #ask(message, ...transfer) {
    return new Promise((done, fail) => {
      this.worker.onmessage = ({ data }) => (data.type === 'done' ? done(data.value) : fail(new Error(data.message)));
      this.worker.onerror = (event) => {
        event.preventDefault();
        fail(new NoWorker(event.message || 'a worker could not be started'));
      };
      this.worker.postMessage(message, transfer);
    });
  }

  close() {
    this.worker.terminate();
  }
}

/**
 * Creates bands for the scene's size and the machine's cores; this worker decodes the first one.
 * @param {Head} head
 * @param {WebAssembly.Module} module
 */
function bandsFor({ scene, reach, bands }, module) {
  const most = bands ? Math.min(MAX_BANDS, navigator.hardwareConcurrency || 1) : 1;
  // shorter bands would mostly decode what others decode, too
  const tallest = Math.max(1, Math.floor(scene.height / (2 * reach)));
  const wanted = Math.min(Math.floor((scene.width * scene.height) / BAND_PIXELS), tallest, most);
  /** @type {(Band | RemoteBand)[]} */
  const all = [new Band(module)];
  try {
    while (all.length < wanted) all.push(new RemoteBand(module));
  } catch {
    // workers may not be able to start other workers
  }
  return all;
}

/**
 * @param {Blob} blob
 * @returns {Promise<Picture>}
 */
async function decodePicture(blob) {
  const bitmap = await createImageBitmap(blob, { premultiplyAlpha: 'none', colorSpaceConversion: 'none', imageOrientation: 'none' });
  const { width, height } = bitmap;
  const context = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true });
  if (!context) throw new Error('the browser has no canvas for workers');
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  const { data } = context.getImageData(0, 0, width, height);
  return { width, height, data };
}

/** A byte buffer that grows with the download. */
class Download {
  /** @param {number} expected bytes, 0 if unknown */
  constructor(expected) {
    this.buffer = new Uint8Array(expected || 1 << 20);
    this.length = 0;
  }

  /** @param {Uint8Array} chunk */
  push(chunk) {
    const need = this.length + chunk.length;
    if (need > MAX_BYTES) throw new Error(`the file is larger than ${MAX_BYTES / 1024 / 1024} MiB`);
    if (need > this.buffer.length) {
      const grown = new Uint8Array(Math.max(need, this.buffer.length * 2));
      grown.set(this.bytes);
      this.buffer = grown;
    }
    this.buffer.set(chunk, this.length);
    this.length = need;
  }

  get bytes() {
    return this.buffer.subarray(0, this.length);
  }

  /** @param {PictureFile} file */
  blob({ start, end, type }) {
    return new Blob([this.bytes.slice(start, end)], { type });
  }
}

/** Loads the decompressor for zstd sections. */
async function unpackerFor() {
  const { unpacked, unpacker } = await import('./unpack.js');
  const module = await unpacker();
  return (/** @type {Uint8Array} */ bytes) => unpacked(module, bytes);
}

/**
 * @param {Wanted} wanted
 * @param {Port} port
 * @param {boolean} alone without further workers
 */
async function load({ url, photoOnly, side, bare }, port, alone) {
  const module = photoOnly ? null : compiled();
  // the await below reports the error
  module?.catch(() => {});
  const response = await fetch(url);
  if (!response.ok) throw new Error(await problemOf(response));
  // with a content encoding, the header counts compressed bytes
  const total = response.headers.get('content-encoding') ? 0 : Number(response.headers.get('content-length')) || 0;
  const download = new Download(Math.min(total, MAX_BYTES));
  const reader = /** @type {ReadableStream<Uint8Array>} */ (response.body).getReader();
  /** @type {Head | null} */
  let head = null;
  /** @type {ReturnType<typeof decodePicture> | null} */
  let photo = null;
  /** @type {ReturnType<typeof unpackerFor> | null} */
  let unpack = null;
  let posted = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    download.push(value);
    if (!head) {
      head = readHead(download.bytes);
      if (head && bare) head.scene.viewBox = { x: 0, y: 0, z: 0 };
      if (head) port.postMessage({ type: 'head', head: { ...head.scene, total: head.bytes } });
      if (head?.packed && !photoOnly) unpack = unpackerFor();
      // the await below reports the error
      unpack?.catch(() => {});
    }
    if (head && !photo && download.length >= head.photo.end) {
      const blob = download.blob(head.photo);
      port.postMessage({ type: 'photo', blob });
      if (photoOnly) return reader.cancel();
      photo = decodePicture(blob);
      // the await below reports the error
      photo.catch(() => {});
    }
    const now = performance.now();
    if (now - posted > POST_EVERY_MS) {
      posted = now;
      port.postMessage({ type: 'progress', received: download.length, total });
    }
  }
  if (!head || !photo || !module) throw new Error('the container is cut off');
  port.postMessage({ type: 'progress', received: download.length, total: download.length });
  const hidden = head.hidden && (await decodePicture(download.blob(head.hidden)).catch(() => null));
  const bytes = unpack ? await (await unpack)(download.bytes) : download.bytes;
  const input = { bytes, photo: await photo, hidden };
  const started = performance.now();
  const { scene, transfer } = await decoded(head, input, await module, { side, alone });
  port.postMessage({ type: 'scene', scene: { ...scene, decodeMs: performance.now() - started } }, { transfer });
}

/**
 * Decodes the scene, with several workers if possible.
 * @param {Head} head
 * @param {Parameters<typeof assembled>[1]} input
 * @param {WebAssembly.Module} module
 * @param {{side?: number, alone: boolean}} options
 * @returns {ReturnType<typeof assembled>}
 */
async function decoded(head, input, module, { side, alone }) {
  const bands = alone ? [new Band(module)] : bandsFor(head, module);
  try {
    return await assembled(head, input, bands, side);
  } catch (error) {
    if (!(error instanceof NoWorker)) throw error;
    return await decoded(head, input, module, { side, alone: true });
  } finally {
    for (const band of bands) band.close();
  }
}

/** @type {Band | null} */
let own = null;

/**
 * @param {Asked} asked
 * @param {Port} port
 */
async function help(asked, port) {
  if ('band' in asked) own = new Band(asked.band.module);
  if (!own) throw new Error('no band was given');
  if ('band' in asked) return port.postMessage({ type: 'done', value: await own.decode(asked.band) });
  if ('deep' in asked) return port.postMessage({ type: 'done', value: await own.deep(asked.deep) });
  const value = await own.strips(asked.strips);
  return port.postMessage({ type: 'done', value }, { transfer: value.map(({ data }) => data.buffer) });
}

/**
 * Answers the requests of a port.
 * @param {Port} port
 * @param {{alone?: boolean}} [options] `alone`: without further workers
 */
export function serve(port, { alone = false } = {}) {
  port.onmessage = async ({ data }) => {
    try {
      await (data.url ? load(data, port, alone) : help(data, port));
    } catch (error) {
      console.error(error.message);
      port.postMessage({ type: 'error', message: error.message });
    }
  };
}

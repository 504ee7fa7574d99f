// Fetches and decodes a container, in a worker (worker.js) or where there can be none on the page's own thread.
// In: {url, photoOnly, side, bare}: with photoOnly it stops once the photo is there; side of the largest texture; bare: the scene is a
// part of another and not continued beyond its borders. Out: {type: 'progress', received, total}, {type: 'head', …},
// {type: 'photo', blob}, {type: 'scene', scene}, {type: 'error', message}.
// In: {band}, then {deep} and {strips}, from another of these in a worker. Out: {type: 'done', value}.

import { assembled } from './assemble.js';
import { Band } from './band.js';
import { readHead } from './head.js';
import { compiled } from './module.js';
import { problemOf } from './problem.js';
import { startWorker } from './start.js';

/** @import { BandJob } from './band.js' */
/** @import { Head, PictureFile } from './head.js' */
/** @import { Layers, Picture } from './scene.js' */

/** @typedef {{url: string, photoOnly?: boolean, side?: number, bare?: boolean}} Wanted a container to load */
/** @typedef {Parameters<Band['deep']>[0]} DeepJob */
/** @typedef {Parameters<Band['strips']>[0]} StripsJob */
/** @typedef {{band: BandJob & {module: WebAssembly.Module}} | {deep: DeepJob} | {strips: StripsJob}} Asked what one of these asks of another */
/** @typedef {{onmessage: ((event: MessageEvent) => void) | null, postMessage: (message: unknown, options?: StructuredSerializeOptions) => void}} Port what is asked and answered through */

/** Most bytes of a container. */
const MAX_BYTES = 512 * 1024 * 1024;
const POST_EVERY_MS = 100;
/** Pixels that are worth a worker, and most workers. */
const BAND_PIXELS = 1_000_000;
const MAX_BANDS = 4;

/** A worker that could not be started, though another was. */
class NoWorker extends Error {}

/** A band that another worker decodes: the calls of `Band`. */
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
    // `cut` gives this band rows of its own
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
 * As many bands as the scene's size and the machine are good for; the first is decoded here.
 * @param {Head} head
 * @param {WebAssembly.Module} module
 */
function bandsFor({ scene, bands }, module) {
  const most = bands ? Math.min(MAX_BANDS, navigator.hardwareConcurrency || 1) : 1;
  const wanted = Math.min(Math.floor((scene.width * scene.height) / BAND_PIXELS), most);
  /** @type {(Band | RemoteBand)[]} */
  const all = [new Band(module)];
  try {
    while (all.length < wanted) all.push(new RemoteBand(module));
  } catch {
    // where a worker may start no other, one is enough
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

/** A byte buffer that grows as the download goes on. */
class Download {
  /** @param {number} expected bytes, 0 where they are not known */
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

/** What unpacks a container, fetched. */
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
  // reported when it is awaited
  module?.catch(() => {});
  const response = await fetch(url);
  if (!response.ok) throw new Error(await problemOf(response));
  // with a content coding the header counts packed bytes
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
      // reported when it is awaited
      unpack?.catch(() => {});
    }
    if (head && !photo && download.length >= head.photo.end) {
      const blob = download.blob(head.photo);
      port.postMessage({ type: 'photo', blob });
      if (photoOnly) return reader.cancel();
      photo = decodePicture(blob);
      // reported when it is awaited
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
 * The scene of a container, by several workers where they can be had.
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
 * Answers what comes through a port.
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

// Fetches and decodes a container off the page's thread.
// In: {url, photoOnly}: with photoOnly it stops once the photo is there. Out: {type: 'progress', received, total}, {type: 'head', …}, {type: 'photo', blob}, {type: 'scene', scene}, {type: 'error', message}.
// In: {band}, a job from another of these workers. Out: {type: 'part', part}.
import { detached, resultBuffers, work } from './bands.js';
import { decode, endOfAll, endOfSection, Kind, picture, readIndex, sceneHead, transferables } from './container.js';
import { problemOf } from './problem.js';
import { startDecoder } from './start.js';
// what those import, named here so that all of it is fetched at once
import './fill.js';
import './grid.js';
import './labels.js';
import './peel.js';
import './planes.js';
import './protobuf.js';
import './range.js';
import './scene.js';
import '../vendor/fzstd.js';

/** Most bytes of a container. */
const MAX_BYTES = 512 * 1024 * 1024;
const POST_EVERY_MS = 100;
/** Pixels that are worth a thread, and most threads: each begins with an empty heap and untried code. */
const BAND_PIXELS = 500_000;
const MAX_BANDS = 4;

/** Threads beside this one that work on bands of labels and of tiles. */
class Helpers {
  #workers = [];

  /** As many as the scene's size and the machine are good for. */
  constructor({ width, height }) {
    const wanted = Math.min(Math.ceil((width * height) / BAND_PIXELS), MAX_BANDS, navigator.hardwareConcurrency || 1);
    try {
      while (this.#workers.length + 1 < wanted) this.#workers.push(startDecoder());
    } catch {
      // where a worker may start no other, one is enough
    }
  }

  get bands() {
    return this.#workers.length + 1;
  }

  /** Works on a band, the last one here; here too where a helper cannot be started. */
  work(band, i) {
    const worker = this.#workers[i];
    // after the others have got theirs
    if (!worker) return Promise.resolve().then(() => work(this.bands > 1 ? detached(band).band : band));
    return new Promise((done, fail) => {
      worker.onmessage = ({ data }) => (data.type === 'part' ? done(data.part) : fail(new Error(data.message)));
      worker.onerror = (event) => {
        event.preventDefault();
        done(work(band));
      };
      const { band: copy, buffers } = detached(band);
      worker.postMessage({ band: copy }, buffers);
    });
  }

  close() {
    for (const worker of this.#workers) worker.terminate();
    this.#workers = [];
  }
}

async function decodePicture({ bytes, type }) {
  const bitmap = await createImageBitmap(new Blob([bytes], { type }), {
    premultiplyAlpha: 'none',
    colorSpaceConversion: 'none',
    imageOrientation: 'none',
  });
  const { width, height } = bitmap;
  const context = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  const { data } = context.getImageData(0, 0, width, height);
  return { width, height, data };
}

/** A byte buffer that grows as the download goes on. */
class Download {
  constructor(expected) {
    this.buffer = new Uint8Array(expected || 1 << 20);
    this.length = 0;
  }

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
}

async function load({ url, photoOnly }) {
  const response = await fetch(url);
  if (!response.ok) throw new Error(await problemOf(response));
  // with a content coding the header counts packed bytes
  const total = response.headers.get('content-encoding') ? 0 : Number(response.headers.get('content-length')) || 0;
  const download = new Download(Math.min(total, MAX_BYTES));
  const reader = response.body.getReader();
  let head = null;
  let helpers = null;
  let photo = null;
  let posted = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    download.push(value);
    if (!head) {
      head = readIndex(download.bytes);
      // they start while the rest comes
      if (head && !photoOnly) helpers = new Helpers(head.index);
      if (head) postMessage({ type: 'head', head: { ...sceneHead(head.index), total: endOfAll(head) } });
    }
    if (head && !photo && download.length >= endOfSection(head, Kind.PHOTO)) {
      photo = showPhoto(download.bytes, head, photoOnly);
      if (photoOnly) return reader.cancel();
    }
    const now = performance.now();
    if (now - posted > POST_EVERY_MS) {
      posted = now;
      postMessage({ type: 'progress', received: download.length, total });
    }
  }
  postMessage({ type: 'progress', received: download.length, total: download.length });
  const started = performance.now();
  const elsewhere = helpers && ((band, i) => helpers.work(band, i));
  const scene = await decode(download.bytes, decodePicture, photo, elsewhere, helpers?.bands).finally(() => helpers?.close());
  scene.decodeMs = performance.now() - started;
  postMessage({ type: 'scene', scene }, transferables(scene));
}

/** Posts the photo's file for the page to show at once, and starts to decode it. */
function showPhoto(bytes, head, photoOnly) {
  const file = picture(bytes, head, Kind.PHOTO);
  // the download's buffer may be replaced while the picture is decoded
  const blob = new Blob([file.bytes], { type: file.type });
  postMessage({ type: 'photo', blob });
  if (photoOnly) return null;
  const decoded = decodePicture({ bytes: blob, type: file.type });
  // reported when it is awaited
  decoded.catch(() => {});
  return decoded;
}

self.onmessage = async ({ data }) => {
  try {
    if (data.band) {
      const part = work(data.band);
      postMessage({ type: 'part', part }, resultBuffers(part));
    } else {
      await load(data);
    }
  } catch (error) {
    postMessage({ type: 'error', message: error.message });
  }
};

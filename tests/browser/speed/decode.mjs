// Measures decoding in Chromium with the WebAssembly and the JavaScript decoder, in alternating rounds, on one thread, without decoding pictures.
// Cold: a new process, including compilation. Again: a new worker that gets the compiled module. Warm: the last run. Pages: filling all texture
// pages, warm; the JavaScript decoder does that on the main thread.
import { launch } from '../support/browser.mjs';

/** Part of both workers: decodes repeatedly and reports the times. */
const COMMON = `
self.onmessage = async ({ data }) => {
  try {
    const bitmap = await createImageBitmap(data.blob, { premultiplyAlpha: 'none', colorSpaceConversion: 'none', imageOrientation: 'none' });
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext('2d', { willReadFrequently: true });
    context.drawImage(bitmap, 0, 0);
    const photo = context.getImageData(0, 0, bitmap.width, bitmap.height);
    const times = [];
    let prepared = data.module;
    let pages = 0;
    let memory = 0;
    for (let i = 0; i < data.runs; i++) {
      const wasm = !prepared && (await source());
      const start = performance.now();
      prepared ??= wasm && (await WebAssembly.compile(wasm));
      const done = await run(prepared, data.bytes, { width: photo.width, height: photo.height, data: photo.data });
      times.push(performance.now() - start);
      const packing = performance.now();
      await done.pages();
      pages = performance.now() - packing;
      memory = done.memory ?? 0;
    }
    postMessage({ times, pages, memory, module: prepared });
  } catch (error) {
    postMessage({ error: error.stack });
  }
};`;
export const WORKERS = {
  '/worker-wasm.js': `
import { pieces } from '/wasm/draw/border.js';
import { pack } from '/wasm/draw/texture-atlas.js';
import { Decoder } from '/wasm/decode/decoder.js';
import { readHead } from '/wasm/decode/head.js';
import { tileCounts } from '/wasm/decode/grid.js';
import { unpacked, unpacker } from '/wasm/decode/unpack.js';
const source = async () => (await fetch('/wasm/decode/decoder.wasm')).arrayBuffer();
async function run(module, bytes, photo) {
  const { scene, packed } = readHead(bytes);
  const decoder = await Decoder.of(module);
  decoder.open(packed ? await unpacked(await unpacker(), bytes) : bytes);
  decoder.picture('photo', photo);
  const { columns, tiles } = tileCounts(scene);
  const layers = decoder.decode(scene, 0, tiles / columns);
  const pages = () => {
    const all = pieces({ ...scene, layers });
    const { bands, width } = pack(all);
    for (const { pieces: own, x, h } of bands) {
      const numbers = own.flatMap((i, k) => [all[i].layer, all[i].u, all[i].v, all[i].w, all[i].h, Number(all[i].flipX) + 2 * Number(all[i].flipY), x[k]]);
      decoder.strip(Uint32Array.from(numbers), width, h);
    }
  };
  return { pages, memory: decoder.memory };
}${COMMON}`,
  '/worker-js.js': `
import { decode } from '/js/container.js';
import { pieces } from '/js/border.js';
import { expandAll, pack } from '/js/pages.js';
const source = async () => null;
async function run(_, bytes, photo) {
  const scene = await decode(bytes, null, photo);
  return { pages: () => { const all = pieces(scene); const places = pack(all, 8192, 256); return expandAll(scene, all, places.bands, places.width, () => {}); } };
}${COMMON}`,
};

/** In the page: runs a worker, then a new one with the compiled module. */
async function measure({ kind, file, runs }) {
  const { readHead } = await import('/wasm/decode/head.js');
  const bytes = new Uint8Array(await (await fetch(`/file/${file}`)).arrayBuffer());
  const { photo, scene } = readHead(bytes);
  const blob = new Blob([bytes.subarray(photo.start, photo.end)], { type: photo.type });
  const work = (module) =>
    new Promise((done, fail) => {
      const worker = new Worker(`/worker-${kind}.js`, { type: 'module' });
      worker.onmessage = ({ data }) => {
        worker.terminate();
        if (data.error) fail(new Error(data.error));
        else done(data);
      };
      worker.onerror = (event) => fail(new Error(event.message));
      worker.postMessage({ bytes, blob, runs, module });
    });
  const first = await work(undefined);
  const again = await work(first.module ?? undefined);
  const megapixels = (scene.width * scene.height) / 1e6;
  return {
    cold: first.times[0],
    again: again.times[0],
    warm: again.times.at(-1),
    pages: again.pages,
    memory: again.memory / 2 ** 20 / megapixels,
  };
}

/**
 * Measures all kinds in alternating order.
 * @param {string} address of the server
 * @param {{kinds: ('wasm' | 'js')[], file: number, runs: number, rounds: number}} options `file`: its index on the server
 */
export async function decodeRounds(address, { kinds, file, runs, rounds }) {
  const results = [];
  for (let round = 0; round < rounds; round++) {
    const result = {};
    for (const kind of round % 2 ? kinds.toReversed() : kinds) {
      const browser = await launch({ webgpu: false });
      const page = await browser.newPage();
      await page.goto(address);
      result[kind] = await page.evaluate(measure, { kind, file, runs });
      await browser.close();
    }
    results.push(result);
  }
  return results;
}

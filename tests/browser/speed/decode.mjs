// Measures decoding in Chromium with the WebAssembly decoder, on one thread, without decoding pictures. Cold: a new process, including
// compilation. Again: a new worker that gets the compiled module. Warm: the last run. Pages: filling all texture pages, warm.
import { launch } from '../support/browser.mjs';

/** Decodes repeatedly and reports the times. */
export const WORKER = `
import { pieces } from '/wasm/draw/border.js';
import { pack } from '/wasm/draw/texture-atlas.js';
import { Decoder } from '/wasm/decode/decoder.js';
import { readHead } from '/wasm/decode/head.js';
import { tileCounts } from '/wasm/decode/grid.js';
import { unpacked, unpacker } from '/wasm/decode/unpack.js';
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
}
self.onmessage = async ({ data }) => {
  try {
    const bitmap = await createImageBitmap(data.blob, { premultiplyAlpha: 'none', colorSpaceConversion: 'none', imageOrientation: 'none' });
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext('2d', { willReadFrequently: true });
    context.drawImage(bitmap, 0, 0);
    const photo = context.getImageData(0, 0, bitmap.width, bitmap.height);
    const times = [];
    let module = data.module;
    let pages = 0;
    let memory = 0;
    for (let i = 0; i < data.runs; i++) {
      const wasm = !module && (await (await fetch('/wasm/decode/decoder.wasm')).arrayBuffer());
      const start = performance.now();
      module ??= await WebAssembly.compile(wasm);
      const done = await run(module, data.bytes, { width: photo.width, height: photo.height, data: photo.data });
      times.push(performance.now() - start);
      const packing = performance.now();
      done.pages();
      pages = performance.now() - packing;
      memory = done.memory;
    }
    postMessage({ times, pages, memory, module });
  } catch (error) {
    postMessage({ error: error.stack });
  }
};`;

/** In the page: runs a worker, then a new one with the compiled module. */
async function measure({ file, runs }) {
  const { readHead } = await import('/wasm/decode/head.js');
  const bytes = new Uint8Array(await (await fetch(`/file/${file}`)).arrayBuffer());
  const { photo, scene } = readHead(bytes);
  const blob = new Blob([bytes.subarray(photo.start, photo.end)], { type: photo.type });
  const work = (module) =>
    new Promise((done, fail) => {
      const worker = new Worker('/worker.js', { type: 'module' });
      worker.onmessage = ({ data }) => {
        worker.terminate();
        if (data.error) fail(new Error(data.error));
        else done(data);
      };
      worker.onerror = (event) => fail(new Error(event.message));
      worker.postMessage({ bytes, blob, runs, module });
    });
  const first = await work(undefined);
  const again = await work(first.module);
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
 * Measures in rounds.
 * @param {string} address of the server
 * @param {{file: number, runs: number, rounds: number}} options `file`: its index on the server
 */
export async function decodeRounds(address, { file, runs, rounds }) {
  const results = [];
  for (let round = 0; round < rounds; round++) {
    const browser = await launch({ webgpu: false });
    const page = await browser.newPage();
    await page.goto(address);
    results.push(await page.evaluate(measure, { file, runs }));
    await browser.close();
  }
  return results;
}

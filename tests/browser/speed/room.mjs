// Measures how long the page's room decoder takes for the frames of a recorded room in Chromium: the work of static/live/worker.js from a decoded
// frame and its tiles to texels. Excludes video decoding and drawing.
import { launch } from '../support/browser.mjs';

/** In the page: milliseconds of each part for each frame, and memory of the decoder. */
async function measure({ file }) {
  const { compiled, RoomDecoder } = await import('/wasm/live/decoder.js');
  const { FrameDecoder } = await import('/wasm/live/frame-decoder.js');
  const { pixelsOf } = await import('/wasm/live/pixels.js');
  const { TileAtlas } = await import('/wasm/live/tile-atlas.js');
  const bytes = new Uint8Array(await (await fetch(`/file/${file}`)).arrayBuffer());
  const messages = [];
  const view = new DataView(bytes.buffer);
  for (let at = 0; at + 4 <= bytes.length; ) {
    const length = view.getUint32(at, true);
    messages.push(bytes.slice(at + 4, at + 4 + length));
    at += 4 + length;
  }
  const module = await compiled();
  // a first pass decodes the pictures, a second one is measured
  const first = await RoomDecoder.of(module);
  const pixels = new Map();
  let hello = null;
  let pictures = null;
  for (const message of messages) {
    const read = first.read(message);
    if (read.kind === 'hello') {
      hello = read;
      pictures?.close();
      pictures = await FrameDecoder.of(
        hello.codec,
        async ({ frame, time, picture }) => {
          pixels.set(frame, null);
          pixels.set(frame, { ...(await pixelsOf(picture, hello.head, true)), frame, time });
          picture.close();
        },
        (error) => console.error(error.message),
      );
    } else if (read.kind === 'video') {
      pictures?.decode(read, 0);
      const since = performance.now();
      while (!pixels.get(read.frame) && performance.now() - since < 2000) await new Promise((resume) => setTimeout(resume, 1));
    }
  }
  const decoder = await RoomDecoder.of(module);
  const times = [];
  let atlas = null;
  let waits = null;
  let scratch;
  let read = 0;
  let tiles = 0;
  const show = () => {
    if (waits === null || !pixels.get(waits)) return;
    const { format, bytes: planes, ...of } = pixels.get(waits);
    waits = null;
    const began = performance.now();
    decoder.frame(format, planes, of);
    const framed = performance.now();
    const changed = decoder.layers();
    const layered = performance.now();
    if (changed.length) {
      atlas ??= new TileAtlas(hello.head, 4096);
      scratch = decoder.cells(atlas.change(changed).numbers, atlas.borderColumns, scratch).buffer;
    }
    const done = performance.now();
    times.push({
      read,
      frame: framed - began,
      layers: layered - framed,
      cells: done - layered,
      all: read + done - began,
      tiles,
      changed: changed.length,
    });
    [read, tiles] = [0, 0];
  };
  for (const message of messages) {
    const began = performance.now();
    const { kind, frame, changed } = decoder.read(message);
    const took = performance.now() - began;
    if (kind === 'video') {
      show();
      waits = frame;
      read += took;
    } else if (kind === 'tiles') {
      read += took;
      tiles += changed;
      if (waits !== null && frame >= waits) show();
    }
  }
  show();
  return { size: [hello.head.width, hello.head.height], times, memory: decoder.memory };
}

/**
 * @param {string} address of the server
 * @param {number} file its index on the server
 */
export async function roomTimes(address, file) {
  const browser = await launch({ webgpu: false });
  try {
    const page = await browser.newPage();
    await page.goto(address);
    return await page.evaluate(measure, { file });
  } finally {
    await browser.close();
  }
}

// Places the pieces of a scene on the pages of a texture array; the decoder fills these with premultiplied RGBA, strip by strip.

/** @import { Piece } from './border.js' */

/**
 * A full-width strip of a page, with the numbers of its pieces and their columns.
 * @typedef {{page: number, y: number, h: number, pieces: number[], x: number[]}} Band
 */
/**
 * Place of each piece, size and count of pages, and the bands that they are filled by.
 * @typedef {{page: Uint32Array, atlasX: Uint32Array, atlasY: Uint32Array, width: number, height: number, pages: number, bands: Band[]}} Places
 */
/**
 * Pages of a texture array, and what they are filled with: strips of their full width, of bytes or, where it is wide, 16-bit floats.
 * @typedef {{page: number, y: number, h: number, data: Uint8Array<ArrayBuffer> | Uint16Array<ArrayBuffer>}} Strip
 * @typedef {{width: number, height: number, pages: number, wide: boolean, strips: Strip[]}} Atlas
 */

/** Width of a page where the scene fits one. */
const PAGE_STEP = 256;
/** Side of a page at most while the pieces themselves are smaller: nearly any graphics device has that. */
const PAGE_SIDE = 4096;
/** Time that uploading may hold the page before it lets others run. */
const SLICE_MS = 8;
/** Bytes that are written at once. */
const PART_BYTES = 2 << 20;
/** Bytes that may wait to be taken over. */
const QUEUE_BYTES = 8 << 20;

/**
 * Shelf packing, tallest rectangles first, as crates/render has it. Pieces of different groups, numbered from 0, share no strip.
 * @param {Pick<Piece, 'w' | 'h'>[]} pieces
 * @param {number[]} [groups] the group of each
 * @param {number} [most] side of a page that the graphics device can hold
 * @returns {Places}
 */
export function pack(pieces, groups = pieces.map(() => 0), most = PAGE_SIDE) {
  const n = pieces.length;
  const order = [...pieces.keys()].sort((i, j) => groups[i] - groups[j] || pieces[j].h - pieces[i].h || i - j);
  let area = 0;
  let [widest, side] = [1, Math.min(PAGE_SIDE, most)];
  for (const { w, h } of pieces) {
    area += w * h;
    widest = Math.max(widest, w);
    side = Math.max(side, w, h);
  }
  const roundUp = (/** @type {number} */ v) => Math.ceil(v / PAGE_STEP) * PAGE_STEP;
  const width = Math.min(side, roundUp(Math.max(widest, Math.sqrt(area))));
  /** @type {Places} */
  const places = {
    page: new Uint32Array(n),
    atlasX: new Uint32Array(n),
    atlasY: new Uint32Array(n),
    width,
    height: 1,
    pages: 1,
    bands: [],
  };
  /** @type {Band | null} */
  let band = null;
  let x = 0;
  let group = 0;
  for (const i of order) {
    const { w, h } = pieces[i];
    if (!band || x + w > width || groups[i] !== group) {
      /** @type {number[]} */
      let [page, y] = band ? [band.page, band.y + band.h] : [0, 0];
      if (y + h > side) [page, y] = [page + 1, 0];
      band = { page, y, h, pieces: [], x: [] };
      places.bands.push(band);
      places.height = Math.max(places.height, y + h);
      places.pages = page + 1;
      x = 0;
      group = groups[i];
    }
    places.page[i] = band.page;
    places.atlasX[i] = x;
    places.atlasY[i] = band.y;
    band.pieces.push(i);
    band.x.push(x);
    x += w;
  }
  return places;
}

/**
 * @param {Atlas} atlas
 * @param {{side: number, pages: number}} most what the graphics device can hold
 * @throws where the atlas does not fit
 */
export function checkFit({ width, height, pages }, most) {
  if (Math.max(width, height) > most.side || pages > most.pages) throw new Error('the layers do not fit the graphics device');
}

/**
 * Hands all strips to `write`, tall ones in parts, with pauses that let the page live; `settle` resolves once what was written is taken
 * over, as a full queue holds the page.
 * @param {Atlas} atlas
 * @param {(strip: Strip) => void} write
 * @param {() => Promise<void>} settle
 */
export async function upload({ strips }, write, settle) {
  // what came before has held the page for a while
  await new Promise((resume) => setTimeout(resume));
  let slice = performance.now();
  let queued = 0;
  for (const strip of strips) {
    for (const part of parts(strip)) {
      write(part);
      queued += part.data.byteLength;
      if (queued < QUEUE_BYTES && performance.now() - slice <= SLICE_MS) continue;
      if (queued < QUEUE_BYTES) await new Promise((resume) => setTimeout(resume));
      else {
        await settle();
        queued = 0;
      }
      slice = performance.now();
    }
  }
}

/**
 * A strip in parts of whole rows that are written in a moment.
 * @param {Strip} strip
 * @returns {Strip[]}
 */
function parts({ page, y, h, data }) {
  const row = data.length / h;
  const rows = Math.max(1, Math.floor(PART_BYTES / (row * data.BYTES_PER_ELEMENT)));
  const out = [];
  for (let at = 0; at < h; at += rows) {
    const end = Math.min(at + rows, h);
    out.push({ page, y: y + at, h: end - at, data: data.subarray(at * row, end * row) });
  }
  return out;
}

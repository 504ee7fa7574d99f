// Packs the pieces of a scene into the pages of a texture array. The decoder fills the pages with premultiplied RGBA, strip by strip.

/** @import { Piece } from './border.js' */

/**
 * A full-width strip of a page, with the indices of its pieces and their columns.
 * @typedef {{page: number, y: number, h: number, pieces: number[], x: number[]}} Band
 */
/**
 * Place of each piece, size and count of the pages, and the bands that fill them.
 * @typedef {{page: Uint32Array, atlasX: Uint32Array, atlasY: Uint32Array, width: number, height: number, pages: number, bands: Band[]}} Places
 */
/**
 * Pages of a texture array, and the full-width strips that fill them: bytes, or 16-bit floats if `wide`.
 * @typedef {{page: number, y: number, h: number, data: Uint8Array<ArrayBuffer> | Uint16Array<ArrayBuffer>}} Strip
 * @typedef {{width: number, height: number, pages: number, wide: boolean, strips: Strip[]}} Atlas
 */

/** Page widths are multiples of this, pixels. */
const PAGE_STEP = 256;
/** Largest side of a page, unless a piece is larger: nearly every graphics device supports it. */
const PAGE_SIDE = 4096;
/** Time that uploading may block the page before it yields, ms. */
const SLICE_MS = 8;
/** Bytes per write. */
const PART_BYTES = 2 << 20;
/** Most bytes queued in the graphics device. */
const QUEUE_BYTES = 8 << 20;

/**
 * Shelf packing, tallest rectangles first, as in crates/render. Pieces of different groups, numbered from 0, share no strip.
 * @param {Pick<Piece, 'w' | 'h'>[]} pieces
 * @param {number[]} [groups] the group of each
 * @param {number} [most] largest side of a page that the graphics device supports
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
 * @param {{side: number, pages: number}} most limits of the graphics device
 * @throws if the atlas does not fit
 */
export function checkFit({ width, height, pages }, most) {
  if (Math.max(width, height) > most.side || pages > most.pages) throw new Error('the layers do not fit the graphics device');
}

/**
 * Passes all strips to `write`, tall ones in parts, with pauses that keep the page responsive. `settle` resolves once the device has
 * processed all writes; a full queue would block the page.
 * @param {Atlas} atlas
 * @param {(strip: Strip) => void} write
 * @param {() => Promise<void>} settle
 */
export async function upload({ strips }, write, settle) {
  // the page may already have been blocked for a while
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
 * Splits a strip into parts of whole rows that are quick to write.
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

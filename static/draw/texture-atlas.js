// Places the pieces of a scene on the pages of a texture array, and fills these with premultiplied RGBA.
import { Class } from '../decode/scene.js';

/** @import { Scene } from '../decode/scene.js' */
/** @import { Piece } from './border.js' */

/**
 * A full-width strip of a page, with the numbers of its pieces and their columns.
 * @typedef {{page: number, y: number, h: number, pieces: number[], x: number[]}} Band
 */
/**
 * Place of each piece, size and count of pages, and the bands that they are filled by.
 * @typedef {{page: Uint32Array, atlasX: Uint32Array, atlasY: Uint32Array, width: number, height: number, pages: number, bands: Band[]}} Places
 */

/** Width of a page where the scene fits one. */
const PAGE_STEP = 256;
/** Time that building may hold the page before it lets others run. */
const SLICE_MS = 12;

/**
 * Shelf packing, tallest rectangles first.
 * @param {{w: number, h: number}[]} pieces
 * @param {number} side largest width and height of a page
 * @param {number} most largest count of pages
 * @returns {Places}
 * @throws where they do not fit
 */
export function pack(pieces, side, most) {
  const n = pieces.length;
  const order = [...pieces.keys()].sort((i, j) => pieces[j].h - pieces[i].h || i - j);
  let area = 0;
  let widest = 1;
  for (const { w, h } of pieces) {
    area += w * h;
    widest = Math.max(widest, w);
  }
  const roundUp = (v) => Math.ceil(v / PAGE_STEP) * PAGE_STEP;
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
  for (const i of order) {
    const { w, h } = pieces[i];
    if (w > side || h > side) throw new Error(`a layer of ${w} × ${h} pixels does not fit the graphics device`);
    if (!band || x + w > width) {
      let [page, y] = band ? [band.page, band.y + band.h] : [0, 0];
      if (y + h > side) [page, y] = [page + 1, 0];
      if (page >= most) throw new Error('the layers do not fit the graphics device');
      band = { page, y, h, pieces: [], x: [] };
      places.bands.push(band);
      places.height = Math.max(places.height, y + h);
      places.pages = page + 1;
      x = 0;
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

/** Expands band after band and hands each to `write(band, data)`, with pauses that let the page live. */
export async function expandAll(scene, pieces, bands, width, write) {
  let slice = performance.now();
  for (const band of bands) {
    write(band, expandBand(scene, pieces, band, width));
    if (performance.now() - slice > SLICE_MS) {
      await new Promise((resume) => setTimeout(resume));
      slice = performance.now();
    }
  }
}

/** Premultiplied RGBA of a band, `width × band.h`. */
function expandBand(scene, pieces, band, width) {
  const { layers, classes, alpha, hidden, photo } = scene;
  const out = new Uint8Array(width * band.h * 4);
  band.pieces.forEach((p, k) => {
    const piece = pieces[p];
    const i = piece.layer;
    const w = layers.w[i];
    let from = layers.firstHidden[i] * 3;
    // hidden colours lie in a row, so those before the piece are counted too
    for (let v = 0; v < piece.v + piece.h; v++) {
      let texel = layers.firstTexel[i] + v * w;
      const inRows = v >= piece.v;
      const row = piece.flipY ? piece.h - 1 - (v - piece.v) : v - piece.v;
      for (let u = 0; u < w; u++, texel++) {
        const kind = classes[texel];
        if (kind === Class.EMPTY) continue;
        const own = from;
        if (kind === Class.HIDDEN) from += 3;
        if (!inRows || u < piece.u || u >= piece.u + piece.w) continue;
        const column = piece.flipX ? piece.w - 1 - (u - piece.u) : u - piece.u;
        const to = (row * width + band.x[k] + column) * 4;
        const a = alpha[texel];
        const visible = kind === Class.PHOTO;
        const source = visible ? photo.data : hidden;
        const at = visible ? ((layers.y[i] + v) * scene.width + layers.x[i] + u) * 4 : own;
        out[to] = premultiplied(source[at], a);
        out[to + 1] = premultiplied(source[at + 1], a);
        out[to + 2] = premultiplied(source[at + 2], a);
        out[to + 3] = a;
      }
    }
  });
  return out;
}

/** `value · alpha / 255`, rounded to nearest. */
function premultiplied(value, alpha) {
  return ((value * alpha + 127) / 255) | 0;
}

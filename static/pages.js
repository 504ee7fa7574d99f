// Places the layers of a scene on the pages of a texture array and fills these with premultiplied RGBA.
import { Class } from './container.js';

/** Width of a page where the scene fits one. */
const PAGE_STEP = 256;

/**
 * Shelf packing, tallest rectangles first.
 * @param {Scene} scene
 * @param {number} side largest width and height of a page
 * @param {number} most largest count of pages
 * @returns places per layer (`page`, `atlasX`, `atlasY`), size and count of pages, and the `bands`: full-width strips with their layers
 * @throws where the layers do not fit
 */
export function pack(scene, side, most) {
  const { layers } = scene;
  const n = layers.count;
  const order = Array.from({ length: n }, (_, i) => i).sort((i, j) => layers.h[j] - layers.h[i] || i - j);
  let area = 0;
  let widest = 1;
  for (let i = 0; i < n; i++) {
    area += layers.w[i] * layers.h[i];
    widest = Math.max(widest, layers.w[i]);
  }
  const roundUp = (v) => Math.ceil(v / PAGE_STEP) * PAGE_STEP;
  const width = Math.min(side, roundUp(Math.max(widest, Math.sqrt(area))));
  const places = { page: new Uint32Array(n), atlasX: new Uint32Array(n), atlasY: new Uint32Array(n), width, height: 1, pages: 1, bands: [] };
  let band = null;
  let x = 0;
  for (const i of order) {
    const [w, h] = [layers.w[i], layers.h[i]];
    if (w > side || h > side) throw new Error(`a layer of ${w} × ${h} pixels does not fit the graphics device`);
    if (!band || x + w > width) {
      let [page, y] = band ? [band.page, band.y + band.h] : [0, 0];
      if (y + h > side) [page, y] = [page + 1, 0];
      if (page >= most) throw new Error('the layers do not fit the graphics device');
      band = { page, y, h, layers: [], x: [] };
      places.bands.push(band);
      places.height = Math.max(places.height, y + h);
      places.pages = page + 1;
      x = 0;
    }
    places.page[i] = band.page;
    places.atlasX[i] = x;
    places.atlasY[i] = band.y;
    band.layers.push(i);
    band.x.push(x);
    x += w;
  }
  return places;
}

/** Premultiplied RGBA of a band, `width × band.h`. */
export function expandBand(scene, band, width) {
  const { layers, classes, alpha, hidden, photo } = scene;
  const out = new Uint8Array(width * band.h * 4);
  band.layers.forEach((i, k) => {
    let texel = layers.firstTexel[i];
    let from = layers.firstHidden[i] * 3;
    for (let v = 0; v < layers.h[i]; v++) {
      let to = (v * width + band.x[k]) * 4;
      let pixel = ((layers.y[i] + v) * scene.width + layers.x[i]) * 4;
      for (let u = 0; u < layers.w[i]; u++, to += 4, pixel += 4, texel++) {
        const kind = classes[texel];
        if (kind === Class.EMPTY) continue;
        const a = alpha[texel];
        const source = kind === Class.PHOTO ? photo.data : hidden;
        const at = kind === Class.PHOTO ? pixel : from;
        if (kind === Class.HIDDEN) from += 3;
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

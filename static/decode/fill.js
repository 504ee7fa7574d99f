// Colour of hidden texels, from photo, planes and labels: the server's src/tmpi/fill.rs, step by step. Numbers are rounded to 32 bits
// where the server's are (all that is kept in a Float32Array), so that both come to the same colours from the same photo.
import { grown, planeLine, planeStep } from './peel.js';

const CONTEXT = 32;
const IN_FRONT = 0.015;
const TOUCH = 0.03;
const BEHIND = 0.06;
const HIDDEN = 2;

/**
 * Colours of the hidden texels of all layers, in their order.
 * @param {object} scene head of a scene, its photo's straight RGBA as `photo.data`, and `top`, the row that photo and surface begin with
 * @param {Array<object>} tiles as `peel` takes them
 * @param {Array<object>} shapes as `peel` gives them
 * @param {number} count hidden texels of all layers
 * @param {Float32Array} surface δ of the visible surface, as many rows as the photo has
 * @returns {Uint8Array} RGB
 */
export function fillHidden(scene, tiles, shapes, count, surface) {
  const out = new Uint8Array(count * 3);
  if (!count) return out;
  const sources = {
    ...scene,
    surface: withoutRim(surface, scene.width, surface.length / scene.width),
    pixels: pixelsOf(scene.photo.data),
    line: new Float64Array(scene.tileSize + 2 * CONTEXT),
  };
  const pyramid = [];
  let at = 0;
  for (const shape of shapes) at = fillLayer(sources, tiles[shape.tile].rect, shape, pyramid, out, at);
  return out;
}

/** RGBA as one number a pixel, red lowest. */
function pixelsOf(data) {
  const aligned = data.byteOffset % 4 === 0 ? data : data.slice();
  return new Uint32Array(aligned.buffer, aligned.byteOffset, aligned.length >> 2);
}

/** The surface with what is no source put before everything: pixels that touch one nearer by more than `TOUCH` are mixed with it. */
function withoutRim(surface, w, h) {
  const rows = new Float32Array(w);
  const out = surface.slice();
  for (let y = 0; y < h; y++) {
    const [above, here, below] = [Math.max(y - 1, 0) * w, y * w, Math.min(y + 1, h - 1) * w];
    for (let x = 0; x < w; x++) {
      let most = surface[here + x];
      if (surface[above + x] > most) most = surface[above + x];
      if (surface[below + x] > most) most = surface[below + x];
      rows[x] = most;
    }
    for (let x = 0; x < w; x++) {
      let most = rows[x];
      if (x > 0 && rows[x - 1] > most) most = rows[x - 1];
      if (x + 1 < w && rows[x + 1] > most) most = rows[x + 1];
      if (most - surface[here + x] > TOUCH) out[here + x] = Infinity;
    }
  }
  return out;
}

function fillLayer(scene, tileRect, shape, pyramid, out, at) {
  const bounds = hiddenBounds(shape);
  if (!bounds) return at;
  const win = grown(bounds, CONTEXT, CONTEXT, scene);
  const used = reset(pyramid, win.w, win.h);
  planeLine(scene, tileRect, shape.plane, win, scene.line);
  gather(scene, tileRect, shape.plane, win, pyramid[1]);
  for (let n = 2; n < used; n++) pull(pyramid[n - 1], pyramid[n]);
  if (!(pyramid[used - 1].texels[3] > 0)) {
    const mean = meanOf(scene, shape);
    for (const kind of shape.classes) {
      if (kind !== HIDDEN) continue;
      out.set(mean, at);
      at += 3;
    }
    return at;
  }
  pushAll(pyramid, used, bounds, win);
  return finest(scene, tileRect, shape, win, pyramid[1], out, at);
}

/** Bounds of the hidden texels in photo pixels, null where there is none. */
function hiddenBounds({ classes, x, y, w }) {
  let [x0, y0, x1, y1] = [Infinity, Infinity, 0, 0];
  for (let i = 0; i < classes.length; i++) {
    if (classes[i] !== HIDDEN) continue;
    const u = i % w;
    const v = (i - u) / w;
    if (u < x0) x0 = u;
    if (u + 1 > x1) x1 = u + 1;
    if (v < y0) y0 = v;
    y1 = v + 1;
  }
  return x1 ? { x: x + x0, y: y + y0, w: x1 - x0, h: y1 - y0 } : null;
}

/**
 * Levels of a pyramid over `w` × `h` texels, finest first; gives their count, at least 2. The finest is never kept: it follows from
 * the photo. One above a single texel has the same colour.
 */
function reset(pyramid, w, h) {
  for (let n = 0; ; n++) {
    const length = n ? w * h * 4 : 0;
    let level = pyramid[n];
    if (!level || level.room.length < length) {
      level = { room: new Float32Array(length) };
      pyramid[n] = level;
    }
    level.texels = level.room.subarray(0, length);
    level.w = w;
    level.h = h;
    if (n && w === 1 && h === 1) return n + 1;
    w = (w + 1) >> 1;
    h = (h + 1) >> 1;
  }
}

/** Sums of 2×2 sources, colour times weight and weight: the level above the finest. */
function gather(scene, tileRect, plane, win, coarse) {
  const { width, top, pixels, surface, line } = scene;
  const { texels } = coarse;
  const { fround } = Math;
  for (let y = 0, to = 0; y < win.h; y += 2) {
    const [step0, step1] = [planeStep(scene, tileRect, plane, win.y + y), planeStep(scene, tileRect, plane, win.y + y + 1)];
    const row0 = (win.y + y - top) * width + win.x;
    const row1 = y + 1 < win.h ? row0 + width : -1;
    for (let x = 0; x < win.w; x += 2, to += 4) {
      let r = 0;
      let g = 0;
      let b = 0;
      let all = 0;
      for (let k = 0; k < 4; k++) {
        const u = x + (k & 1);
        const row = k < 2 ? row0 : row1;
        if (u >= win.w || row < 0) continue;
        const behind = fround(line[u] + (k < 2 ? step0 : step1)) - surface[row + u];
        if (behind < -IN_FRONT) continue;
        const rgba = pixels[row + u];
        if (behind > 0) {
          const far = behind / BEHIND;
          const weight = 1 / (1 + far * far);
          r = fround(r + fround((rgba & 255) * weight));
          g = fround(g + fround(((rgba >>> 8) & 255) * weight));
          b = fround(b + fround(((rgba >>> 16) & 255) * weight));
          all = fround(all + fround(weight));
        } else {
          r = fround(r + (rgba & 255));
          g = fround(g + ((rgba >>> 8) & 255));
          b = fround(b + ((rgba >>> 16) & 255));
          all = fround(all + 1);
        }
      }
      texels[to] = r;
      texels[to + 1] = g;
      texels[to + 2] = b;
      texels[to + 3] = all;
    }
  }
  saturate(texels);
}

/** Weight at most 1, so that one source suffices where there is no other. */
function saturate(texels) {
  for (let i = 0; i < texels.length; i += 4) {
    if (!(texels[i + 3] > 1)) continue;
    const s = 1 / texels[i + 3];
    for (let c = 0; c < 4; c++) texels[i + c] *= s;
  }
}

/** Sums of 2×2 texels. */
function pull(fine, coarse) {
  const { texels } = coarse;
  texels.fill(0);
  for (let y = 0, i = 0; y < fine.h; y++) {
    const row = (y >> 1) * coarse.w;
    for (let x = 0; x < fine.w; x++, i += 4) {
      const to = (row + (x >> 1)) * 4;
      texels[to] += fine.texels[i];
      texels[to + 1] += fine.texels[i + 1];
      texels[to + 2] += fine.texels[i + 2];
      texels[to + 3] += fine.texels[i + 3];
    }
  }
  saturate(texels);
}

/** Gives the texels that the rectangle `bounds` of the finest level is mixed from their full colour, coarsest level first. */
function pushAll(pyramid, used, bounds, win) {
  let [x0, y0] = [bounds.x - win.x, bounds.y - win.y];
  let [x1, y1] = [x0 + bounds.w, y0 + bounds.h];
  const regions = [];
  for (let n = 1; n < used; n++) {
    const { w, h } = pyramid[n];
    [x0, y0] = [Math.max((x0 >> 1) - 1, 0), Math.max((y0 >> 1) - 1, 0)];
    [x1, y1] = [Math.min(((x1 - 1) >> 1) + 2, w), Math.min(((y1 - 1) >> 1) + 2, h)];
    regions[n] = [x0, y0, x1, y1];
  }
  for (let n = used - 1; n > 0; n--) push(pyramid[n], n + 1 < used ? pyramid[n + 1] : null, regions[n]);
}

/** Full colours within a rectangle of a level: its own where the weight is 1, the coarser level's where it is 0. */
function push({ texels, w }, coarse, [x0, y0, x1, y1]) {
  for (let y = y0; y < y1; y++) {
    for (let x = x0, i = (y * w + x0) * 4; x < x1; x++, i += 4) {
      const weight = texels[i + 3];
      // a colour of weight 1 is full
      if (weight === 1) continue;
      if (coarse && weight < 1) {
        for (let k = 0; k < 3; k++) texels[i + k] += (1 - weight) * bilinear(coarse, x, y, k);
      } else if (weight > 0) {
        for (let k = 0; k < 3; k++) texels[i + k] /= weight;
      }
    }
  }
}

/** Channel `k` of a finer level's texel `(x, y)` from this level, bilinear between texel centres. */
function bilinear({ texels, w, h }, x, y, k) {
  const x0 = x >> 1;
  const y0 = y >> 1;
  const x1 = x & 1 ? Math.min(x0 + 1, w - 1) : Math.max(x0 - 1, 0);
  const y1 = y & 1 ? Math.min(y0 + 1, h - 1) : Math.max(y0 - 1, 0);
  const b = texels[(y0 * w + x1) * 4 + k];
  const c = texels[(y1 * w + x0) * 4 + k];
  return 0.5625 * texels[(y0 * w + x0) * 4 + k] + 0.1875 * (b + c) + 0.0625 * texels[(y1 * w + x1) * 4 + k];
}

/** Colours of the hidden texels from the level above and from the sources that some of them are. */
function finest(scene, tileRect, { classes, x: left, y: upper, w, plane }, win, coarse, out, at) {
  const { width, top, pixels, surface, line } = scene;
  const { fround } = Math;
  for (let i = 0, y = upper - win.y; i < classes.length; y++) {
    const step = planeStep(scene, tileRect, plane, win.y + y);
    const from = (win.y + y - top) * width + win.x;
    for (let x = left - win.x; x < left - win.x + w; x++, i++) {
      if (classes[i] !== HIDDEN) continue;
      const behind = fround(line[x] + step) - surface[from + x];
      let exact = 0;
      let weight = 0;
      if (!(behind < -IN_FRONT)) {
        const far = behind > 0 ? behind / BEHIND : 0;
        exact = 1 / (1 + far * far);
        weight = fround(exact);
      }
      const rgba = pixels[from + x];
      for (let k = 0; k < 3; k++) {
        let colour = fround(((rgba >>> (8 * k)) & 255) * exact);
        if (weight < 1) colour += (1 - weight) * bilinear(coarse, x, y, k);
        out[at++] = Math.min(Math.max(Math.round(fround(colour)), 0), 255);
      }
    }
  }
  return at;
}

/** Mean colour of the photo over a rectangle, rounded down. */
function meanOf({ photo, width, top }, { x, y, w, h }) {
  const sum = [0, 0, 0];
  for (let v = y; v < y + h; v++) {
    for (let u = x; u < x + w; u++) for (let c = 0; c < 3; c++) sum[c] += photo.data[((v - top) * width + u) * 4 + c];
  }
  return sum.map((s) => Math.floor(s / (w * h)));
}

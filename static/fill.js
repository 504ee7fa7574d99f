// Colour of hidden texels, from photo, planes and labels: the server's src/tmpi/fill.rs, step by step. Numbers are rounded to 32 bits
// where the server's are (all that is kept in a Float32Array), so that both come to the same colours from the same photo.
import { grown, planeMap, surfaceOf } from './peel.js';

const CONTEXT = 32;
const IN_FRONT = 0.015;
const TOUCH = 0.03;
const BEHIND = 0.06;
const HIDDEN = 2;

/**
 * Colours of the hidden texels of all layers, in their order.
 * @param {object} scene head of a scene and its photo: `{width, height, data}`, straight RGBA
 * @param {Array<object>} tiles as `peel` takes them
 * @param {Array<object>} shapes as `peel` gives them
 * @param {number} count hidden texels of all layers
 * @returns {Uint8Array} RGB
 */
export function fillHidden(scene, tiles, shapes, count) {
  const out = new Uint8Array(count * 3);
  if (!count) return out;
  const surface = surfaceOf(scene, tiles);
  const sources = { ...scene, surface, rim: rimOf(surface, scene.width, scene.height) };
  const pyramid = [];
  let at = 0;
  for (const shape of shapes) at = fillLayer(sources, tiles[shape.tile].rect, shape, pyramid, out, at);
  return out;
}

/** 1 where a pixel touches a surface nearer by more than `TOUCH`: it is mixed with that, and no source. */
function rimOf(surface, w, h) {
  const rows = new Float32Array(w * h);
  for (let y = 0; y < h; y++) {
    const [above, here, below] = [Math.max(y - 1, 0) * w, y * w, Math.min(y + 1, h - 1) * w];
    for (let x = 0; x < w; x++) rows[here + x] = Math.max(surface[above + x], surface[here + x], surface[below + x]);
  }
  const rim = new Uint8Array(w * h);
  for (let y = 0; y < h; y++) {
    for (let x = 0; x < w; x++) {
      const i = y * w + x;
      let most = rows[i];
      if (x > 0 && rows[i - 1] > most) most = rows[i - 1];
      if (x + 1 < w && rows[i + 1] > most) most = rows[i + 1];
      if (most - surface[i] > TOUCH) rim[i] = 1;
    }
  }
  return rim;
}

function fillLayer(scene, tileRect, shape, pyramid, out, at) {
  const bounds = hiddenBounds(shape);
  if (!bounds) return at;
  const win = grown(bounds, CONTEXT, CONTEXT, scene);
  const used = reset(pyramid, win.w, win.h);
  writeSources(scene, planeMap(scene, tileRect, shape.plane, win), win, pyramid[0]);
  for (let n = 1; n < used; n++) pull(pyramid[n - 1], pyramid[n]);
  const { classes, w, x: left, y: top } = shape;
  if (!(pyramid[used - 1].texels[3] > 0)) {
    const mean = meanOf(scene.photo, shape);
    for (let i = 0; i < classes.length; i++) {
      if (classes[i] !== HIDDEN) continue;
      out.set(mean, at);
      at += 3;
    }
    return at;
  }
  const colour = new Float64Array(3);
  for (let n = used - 1; n > 0; n--) push(pyramid[n], n + 1 < used ? pyramid[n + 1] : null, colour);
  const coarse = used > 1 ? pyramid[1] : null;
  for (let i = 0; i < classes.length; i++) {
    if (classes[i] !== HIDDEN) continue;
    full(pyramid[0], coarse, left - win.x + (i % w), top - win.y + Math.floor(i / w), colour);
    for (let c = 0; c < 3; c++) out[at++] = Math.min(Math.max(Math.round(Math.fround(colour[c])), 0), 255);
  }
  return at;
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

/** Empties the levels of a pyramid over `w` × `h` texels, finest first; gives their count. */
function reset(pyramid, w, h) {
  for (let n = 0; ; n++) {
    const length = w * h * 4;
    let level = pyramid[n];
    if (!level || level.room.length < length) {
      level = { room: new Float32Array(length) };
      pyramid[n] = level;
    } else {
      level.room.fill(0, 0, length);
    }
    level.texels = level.room.subarray(0, length);
    level.w = w;
    level.h = h;
    if (w === 1 && h === 1) return n + 1;
    w = (w + 1) >> 1;
    h = (h + 1) >> 1;
  }
}

/** Colour times weight, and weight, of every source in `win`. */
function writeSources({ width, photo, surface, rim }, plane, win, { texels }) {
  const { data } = photo;
  for (let y = 0, i = 0; y < win.h; y++) {
    let from = (win.y + y) * width + win.x;
    for (let x = 0; x < win.w; x++, i++, from++) {
      const behind = plane[i] - surface[from];
      if (behind < -IN_FRONT || rim[from]) continue;
      const far = Math.max(behind, 0) / BEHIND;
      const weight = 1 / (1 + far * far);
      texels[i * 4] = data[from * 4] * weight;
      texels[i * 4 + 1] = data[from * 4 + 1] * weight;
      texels[i * 4 + 2] = data[from * 4 + 2] * weight;
      texels[i * 4 + 3] = weight;
    }
  }
}

/** Sums of 2×2 texels, weight saturated at 1, so that one source suffices where there is no other. */
function pull(fine, coarse) {
  const { texels } = coarse;
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
  for (let i = 0; i < texels.length; i += 4) {
    if (!(texels[i + 3] > 1)) continue;
    const s = 1 / texels[i + 3];
    for (let c = 0; c < 4; c++) texels[i + c] *= s;
  }
}

/** Gives every texel of a level its full colour. */
function push(level, coarse, colour) {
  const { texels, w, h } = level;
  for (let y = 0, i = 0; y < h; y++) {
    for (let x = 0; x < w; x++, i += 4) {
      const some = full(level, coarse, x, y, colour);
      texels[i] = colour[0];
      texels[i + 1] = colour[1];
      texels[i + 2] = colour[2];
      texels[i + 3] = some;
    }
  }
}

/** Full colour of a texel into `out`: its own where the weight is 1, the coarser level's where it is 0. Gives the weight it has then. */
function full({ texels, w }, coarse, x, y, out) {
  const i = (y * w + x) * 4;
  const weight = texels[i + 3];
  if (coarse && weight < 1) {
    const rest = 1 - weight;
    const x0 = x >> 1;
    const y0 = y >> 1;
    const x1 = x & 1 ? Math.min(x0 + 1, coarse.w - 1) : Math.max(x0 - 1, 0);
    const y1 = y & 1 ? Math.min(y0 + 1, coarse.h - 1) : Math.max(y0 - 1, 0);
    const t = coarse.texels;
    const [a, b] = [(y0 * coarse.w + x0) * 4, (y0 * coarse.w + x1) * 4];
    const [c, d] = [(y1 * coarse.w + x0) * 4, (y1 * coarse.w + x1) * 4];
    for (let k = 0; k < 3; k++) {
      out[k] = texels[i + k] + rest * (0.5625 * t[a + k] + 0.1875 * (t[b + k] + t[c + k]) + 0.0625 * t[d + k]);
    }
    return 1;
  }
  for (let k = 0; k < 3; k++) out[k] = weight > 0 ? texels[i + k] / weight : texels[i + k];
  return weight > 0 ? 1 : 0;
}

/** Mean colour of the photo over a rectangle, rounded down. */
function meanOf({ data, width }, { x, y, w, h }) {
  const sum = [0, 0, 0];
  for (let v = y; v < y + h; v++) {
    for (let u = x; u < x + w; u++) for (let c = 0; c < 3; c++) sum[c] += data[(v * width + u) * 4 + c];
  }
  return sum.map((s) => Math.floor(s / (w * h)));
}

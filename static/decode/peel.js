// Which texels each layer has, from planes and labels alone: the server's src/tmpi/peel.rs, step by step. Numbers are rounded to
// 32 bits where the server's are, so that both come to the same texels bit for bit.
import { broken } from './protobuf.js';

const MAX_REACH = 96;
/** Rows above and below a tile that its layers depend on. */
export const MARGIN_ROWS = MAX_REACH + 2;
const MARGIN = 1.5;
const OPEN = 0.004;
const SEAM = 1;
/** After each row of a window, an open and a closed pixel: a search for either ends there. */
const SENTINELS = 2;
/** Bounds on the pixels that peeling may look at: in all, for each pixel of the photo, and for even the smallest photo. */
const MAX_WORK = 8e9;
const PIXEL_WORK = 20_000;
const LEAST_WORK = 5e7;
const [EMPTY, PHOTO, HIDDEN] = [0, 1, 2];

/**
 * Shapes of all layers, tile by tile and from far to near at each tile's centre.
 * @param {object} scene head of a scene: size, tile size, intrinsics, view box; `top`, the row that `surface` begins with, if not 0
 * @param {Array<{rect: object, planes: object[], labels: Uint8Array, backstop: object | null}>} tiles
 * @param {Float32Array} [surface] what `surfaceOf` gives, at least `MARGIN_ROWS` rows beyond the tiles
 * @returns {Array<{tile: number, plane: object, x: number, y: number, w: number, h: number, classes: Uint8Array, alpha: Uint8Array}>}
 */
export function peel(scene, tiles, surface = surfaceOf(scene, tiles)) {
  const layers = [];
  const room = roomFor(scene);
  const placed = { top: 0, ...scene };
  tiles.forEach((tile, index) => {
    const own = peelTile(placed, tile, surface, room);
    own.sort((p, q) => p.plane.a - q.plane.a);
    for (const layer of own) layers.push({ tile: index, ...layer });
  });
  return layers;
}

/** Memory that every tile uses again. */
function roomFor({ width, height, tileSize }) {
  const tile = Math.min(tileSize, width) * Math.min(tileSize, height);
  const [w, h] = [Math.min(tileSize + 2 * MAX_REACH, width), Math.min(tileSize + 2 * MAX_REACH, height)];
  return {
    delta: new Float32Array(tile),
    visible: new Float32Array(tile),
    hidden: new Uint8Array(tile),
    classes: new Uint8Array(tile),
    alpha: new Uint8Array(tile),
    open: new Uint8Array((w + SENTINELS) * h),
    rows: new Uint8Array(tileSize * h),
    sums: new Uint8Array(tile),
    line: new Float64Array(w),
    until: new Int32Array(tileSize),
  };
}

/** The rectangle grown by `dx`, `dy` pixels and clipped to the photo. */
export function grown(rect, dx, dy, { width, height }) {
  const x = Math.max(rect.x - dx, 0);
  const y = Math.max(rect.y - dy, 0);
  return { x, y, w: Math.min(rect.x + rect.w + dx, width) - x, h: Math.min(rect.y + rect.h + dy, height) - y };
}

/** Refuses more planes than a photo of this size can have: `planes` of each tile's rectangle, backstops left out. */
export function checkWork(scene, rects, planes) {
  let work = 0;
  rects.forEach((rect, tile) => {
    const window = grown(rect, MAX_REACH, MAX_REACH, scene);
    work += window.w * window.h * (planes[tile] + 1);
  });
  const most = Math.min(MAX_WORK, LEAST_WORK + scene.width * scene.height * PIXEL_WORK);
  if (work > most) broken('more planes than a photo of this size can have');
}

/** `a + b u` of a plane of the tile with rectangle `rect` along a row of `over`, into `out`; δ is that plus `planeStep`, rounded. */
export function planeLine(scene, rect, plane, over, out) {
  const half = scene.tileSize / 2;
  const centre = rect.x + half;
  for (let i = 0; i < over.w; i++) out[i] = plane.a + plane.b * ((over.x + i + 0.5 - centre) / half);
  return out;
}

/** `c v` of a plane in row `y` of the photo. */
export function planeStep(scene, rect, plane, y) {
  const half = scene.tileSize / 2;
  return plane.c * ((y + 0.5 - (rect.y + half)) / half);
}

/** δ of a plane over its tile. */
function planeMap(scene, rect, plane, line, out) {
  planeLine(scene, rect, plane, rect, line);
  for (let y = 0, i = 0; y < rect.h; y++) {
    const step = planeStep(scene, rect, plane, rect.y + y);
    for (let x = 0; x < rect.w; x++, i++) out[i] = line[x] + step;
  }
}

/** δ of the visible surface over a tile. */
function visibleOf(scene, { rect, planes, labels }, line, out) {
  planes.forEach((plane, label) => {
    planeLine(scene, rect, plane, rect, line);
    for (let y = 0, i = 0; y < rect.h; y++) {
      const step = planeStep(scene, rect, plane, rect.y + y);
      for (let x = 0; x < rect.w; x++, i++) if (labels[i] === label) out[i] = line[x] + step;
    }
  });
}

/** δ of the visible surface per pixel of the photo; where tiles overlap, of the one that comes last. */
export function surfaceOf(scene, tiles) {
  const surface = new Float32Array(scene.width * scene.height);
  const { line, visible } = roomFor(scene);
  for (const tile of tiles) {
    const { rect } = tile;
    visibleOf(scene, tile, line, visible);
    for (let y = 0; y < rect.h; y++) {
      surface.set(visible.subarray(y * rect.w, (y + 1) * rect.w), (rect.y + y) * scene.width + rect.x);
    }
  }
  return surface;
}

function peelTile(scene, tile, surface, room) {
  const { rect, planes, labels } = tile;
  // the one plane of a tile is all visible
  if (planes.length === 1 && !tile.backstop) {
    const all = labels.length;
    return [{ plane: planes[0], ...rect, classes: new Uint8Array(all).fill(PHOTO), alpha: new Uint8Array(all).fill(255) }];
  }
  visibleOf(scene, tile, room.line, room.visible);
  const { px, py } = parallaxOf(scene, rect);
  const layers = [];
  const add = (label, plane) => {
    planeMap(scene, rect, plane, room.line, room.delta);
    markHidden(scene, tile, label, plane, surface, room);
    const layer = shape(scene, tile, label, plane, Math.max(px, py), room);
    if (layer) layers.push(layer);
  };
  planes.forEach((plane, label) => add(label, plane));
  if (tile.backstop) add(-1, tile.backstop);
  return layers;
}

/** Parallax in pixels, right and down, of a unit of disparity within a rectangle over the view box. */
function parallaxOf({ intrinsics: k, viewBox }, rect) {
  const reach = (from, length, c) => Math.max(Math.abs(from - c), Math.abs(from + length - c));
  return {
    px: k.fx * viewBox.x + reach(rect.x, rect.w, k.cx) * viewBox.z,
    py: k.fy * viewBox.y + reach(rect.y, rect.h, k.cy) * viewBox.z,
  };
}

/** Marks in `room.hidden` the texels behind the visible surface that a camera in the view box can look at. */
function markHidden(scene, { rect, labels }, label, plane, surface, room) {
  const { hidden, delta, visible, open, line } = room;
  let any = false;
  let step = 0;
  for (let i = 0; i < labels.length; i++) {
    const behind = labels[i] !== label && delta[i] < visible[i] && delta[i] >= 0;
    hidden[i] = behind ? 1 : 0;
    if (!behind) continue;
    any = true;
    if (visible[i] - delta[i] > step) step = visible[i] - delta[i];
  }
  if (!any) return;
  const { px, py } = parallaxOf(scene, rect);
  const reach = (parallax, by) => Math.ceil(Math.min(by * parallax + MARGIN, MAX_REACH));
  const win = grown(rect, reach(px, step), reach(py, step), scene);
  planeLine(scene, rect, plane, win, line);
  let nearest = 0;
  let least = Infinity;
  for (let y = 0, i = 0; y < win.h; y++) {
    const from = (win.y + y - scene.top) * scene.width + win.x;
    const row = planeStep(scene, rect, plane, win.y + y);
    for (let x = 0; x < win.w; x++, i++) {
      const d = surface[from + x];
      const q = Math.fround(line[x] + row);
      open[i] = d <= q + OPEN ? 1 : 0;
      if (d > nearest) nearest = d;
      if (q < least) least = q;
    }
    open[i++] = 1;
    open[i++] = 0;
  }
  const most = Math.max(nearest - Math.max(least, 0), step);
  keepNear(room, rect, win, reach(px, most), reach(py, most));
}

/** Keeps the hidden texels within `rx`, `ry` pixels of an open one: a box dilation over the window, asked for in the tile alone. */
function keepNear({ hidden, open, rows, until }, rect, win, rx, ry) {
  const [left, top] = [rect.x - win.x, rect.y - win.y];
  rows.fill(0, 0, rect.w * win.h);
  // the next row of the tile that is not known to be near in full
  let next = 0;
  for (let y = 0; y < win.h; y++) {
    const from = y * (win.w + SENTINELS);
    const to = y * rect.w;
    let done = 0;
    let gaps = false;
    for (let x = open.indexOf(1, from) - from; x < win.w && done < rect.w; ) {
      const last = open.indexOf(0, from + x) - from;
      const start = Math.max(x - rx - left, done);
      const end = Math.min(Math.min(last, win.w) + rx - left, rect.w);
      if (end > start) {
        rows.fill(1, to + start, to + end);
        if (start > done) gaps = true;
        done = end;
      }
      x = last < win.w ? open.indexOf(1, from + last) - from : win.w;
    }
    if (!gaps && done >= rect.w && y - ry - top <= next) next = Math.max(next, y + ry + 1 - top);
  }
  if (next >= rect.h) return;
  // columns: how far down the last set pixel reaches, and how far up the next
  until.fill(0);
  for (let y = 0; y < Math.min(top + rect.h, win.h); y++) {
    for (let x = 0; x < rect.w; x++) {
      if (rows[y * rect.w + x]) until[x] = y + ry + 1;
      // 3: behind something, and near from above
      if (y >= top && y < until[x]) hidden[(y - top) * rect.w + x] *= 3;
    }
  }
  until.fill(win.h);
  for (let y = win.h - 1; y >= top; y--) {
    const inside = y < top + rect.h;
    for (let x = 0; x < rect.w; x++) {
      if (rows[y * rect.w + x]) until[x] = Math.max(y - ry, 0);
      if (!inside) continue;
      const at = (y - top) * rect.w + x;
      if (hidden[at] === 1 && y < until[x]) hidden[at] = 0;
    }
  }
}

/** Visible, hidden and soft texels of a layer, cut to its bounds; null where nothing is left. */
function shape(scene, { rect, planes, labels }, label, plane, parallax, room) {
  const { w, h } = rect;
  const { classes, alpha, hidden } = room;
  let any = 0;
  for (let i = 0; i < labels.length; i++) {
    const kind = labels[i] === label ? PHOTO : hidden[i] ? HIDDEN : EMPTY;
    classes[i] = kind;
    alpha[i] = kind === EMPTY ? 0 : 255;
    any |= kind;
  }
  if (!any) return null;
  if (label >= 0) soften(scene, { rect, planes, labels }, label, parallax, room);
  const b = bounds(classes, w, h);
  const cut = (from) => {
    const out = new Uint8Array(b.w * b.h);
    for (let y = 0; y < b.h; y++) out.set(from.subarray((b.y + y) * w + b.x, (b.y + y) * w + b.x + b.w), y * b.w);
    return out;
  };
  return { plane, x: rect.x + b.x, y: rect.y + b.y, w: b.w, h: b.h, classes: cut(classes), alpha: cut(alpha) };
}

/** One ring of soft texels outside, where the layer lies in front; opaque where it is hardly so and the surface is bent. */
function soften(scene, tile, label, parallax, { classes, alpha, delta, visible, sums }) {
  const { w, h } = tile.rect;
  // opaque texels among three of a row
  for (let y = 0, i = 0; y < h; y++) {
    let before = 0;
    let here = alpha[i] >> 7;
    for (let x = 0; x < w; x++, i++) {
      const after = x + 1 < w ? alpha[i + 1] >> 7 : 0;
      sums[i] = before + here + after;
      before = here;
      here = after;
    }
  }
  for (let y = 0, i = 0; y < h; y++) {
    for (let x = 0; x < w; x++, i++) {
      if (classes[i] !== EMPTY) continue;
      const set = (y > 0 ? sums[i - w] : 0) + sums[i] + (y + 1 < h ? sums[i + w] : 0);
      if (!set) continue;
      const front = (delta[i] - visible[i]) * parallax;
      if (!(front > 0)) continue;
      const all = (1 + (x > 0) + (x + 1 < w)) * (1 + (y > 0) + (y + 1 < h));
      classes[i] = PHOTO;
      const bent = front <= SEAM && isBent(scene, tile, label, x, y, delta);
      alpha[i] = bent ? 255 : Math.floor((255 * set + (all >> 1)) / all);
    }
  }
}

/** Whether the layer that shows at a pixel of the ring has no texel under one of the layer's own pixels beside it. */
function isBent(scene, { rect, planes, labels }, label, x, y, delta) {
  const { w, h } = rect;
  const { a, b, c } = planes[labels[y * w + x]];
  const half = scene.tileSize / 2;
  for (let v = Math.max(y - 1, 0); v < Math.min(y + 2, h); v++) {
    for (let u = Math.max(x - 1, 0); u < Math.min(x + 2, w); u++) {
      const i = v * w + u;
      if (labels[i] !== label) continue;
      const d = Math.fround(a + b * ((u + 0.5 - half) / half) + c * ((v + 0.5 - half) / half));
      if (d >= delta[i] || d < 0) return true;
    }
  }
  return false;
}

function bounds(classes, w, h) {
  let [x0, y0, x1, y1] = [w, h, 0, 0];
  for (let y = 0; y < h; y++) {
    for (let x = 0; x < w; x++) {
      if (classes[y * w + x] === EMPTY) continue;
      if (x < x0) x0 = x;
      if (x + 1 > x1) x1 = x + 1;
      if (y < y0) y0 = y;
      if (y + 1 > y1) y1 = y + 1;
    }
  }
  [x0, y0, x1, y1] = [Math.max(x0 - 1, 0), Math.max(y0 - 1, 0), Math.min(x1 + 1, w), Math.min(y1 + 1, h)];
  return { x: x0, y: y0, w: x1 - x0, h: y1 - y0 };
}

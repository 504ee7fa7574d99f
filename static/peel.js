// Which texels each layer has, from planes and labels alone: the server's src/tmpi/peel.rs, step by step. Numbers are rounded to
// 32 bits where the server's are, so that both come to the same texels bit for bit.
import { broken } from './protobuf.js';

const MAX_REACH = 96;
const MARGIN = 1.5;
const OPEN = 0.004;
const SEAM = 1;
/** Bound on the pixels that peeling may look at. */
const MAX_WORK = 8e9;
const [EMPTY, PHOTO, HIDDEN] = [0, 1, 2];

/**
 * Shapes of all layers, tile by tile and from far to near at each tile's centre.
 * @param {object} scene head of a scene: size, tile size, intrinsics, view box
 * @param {Array<{rect: object, planes: object[], labels: Uint8Array, backstop: object | null}>} tiles
 * @returns {Array<{tile: number, plane: object, x: number, y: number, w: number, h: number, classes: Uint8Array, alpha: Uint8Array}>}
 */
export function peel(scene, tiles) {
  checkWork(scene, tiles);
  const surface = surfaceOf(scene, tiles);
  const layers = [];
  tiles.forEach((tile, index) => {
    const own = peelTile(scene, tile, surface);
    own.sort((p, q) => p.plane.a - q.plane.a);
    for (const layer of own) layers.push({ tile: index, ...layer });
  });
  return layers;
}

/** The rectangle grown by `dx`, `dy` pixels and clipped to the photo. */
export function grown(rect, dx, dy, { width, height }) {
  const x = Math.max(rect.x - dx, 0);
  const y = Math.max(rect.y - dy, 0);
  return { x, y, w: Math.min(rect.x + rect.w + dx, width) - x, h: Math.min(rect.y + rect.h + dy, height) - y };
}

function checkWork(scene, tiles) {
  let work = 0;
  for (const { rect, planes } of tiles) {
    const window = grown(rect, MAX_REACH, MAX_REACH, scene);
    work += window.w * window.h * (planes.length + 1);
  }
  if (work > MAX_WORK) broken('more planes than a photo of this size can have');
}

/** δ of a plane along a row of pixels, into `out`. */
function row(scene, rect, plane, x, y, count, out, at) {
  const half = scene.tileSize / 2;
  const { cx, cy } = centre(scene, rect);
  const v = (y + 0.5 - cy) / half;
  for (let i = 0; i < count; i++) out[at + i] = plane.a + (plane.b * ((x + i + 0.5 - cx) / half)) + plane.c * v;
}

/** Tile centre before clipping; tiles start at their rectangle's corner. */
function centre(scene, rect) {
  return { cx: rect.x + scene.tileSize / 2, cy: rect.y + scene.tileSize / 2 };
}

/** δ of the plane of a tile with rectangle `rect` over the rectangle `over`. */
export function planeMap(scene, rect, plane, over) {
  const out = new Float32Array(over.w * over.h);
  for (let y = 0; y < over.h; y++) row(scene, rect, plane, over.x, over.y + y, over.w, out, y * over.w);
  return out;
}

function visibleOf(scene, { rect, planes, labels }) {
  const maps = planes.map((plane) => planeMap(scene, rect, plane, rect));
  const out = new Float32Array(labels.length);
  for (let i = 0; i < out.length; i++) out[i] = maps[labels[i]][i];
  return { maps, visible: out };
}

/** δ of the visible surface per pixel; where tiles overlap, of the one that comes last. */
export function surfaceOf(scene, tiles) {
  const surface = new Float32Array(scene.width * scene.height);
  for (const tile of tiles) {
    const { rect } = tile;
    const { visible } = visibleOf(scene, tile);
    for (let y = 0; y < rect.h; y++) {
      surface.set(visible.subarray(y * rect.w, (y + 1) * rect.w), (rect.y + y) * scene.width + rect.x);
    }
  }
  return surface;
}

function peelTile(scene, tile, surface) {
  const { rect } = tile;
  const { maps, visible } = visibleOf(scene, tile);
  const { px, py } = parallaxOf(scene, rect);
  const parallax = Math.max(px, py);
  const layers = [];
  const add = (label, plane, delta) => {
    const hidden = hiddenMask(scene, tile, label, plane, delta, visible, surface);
    const layer = shape(rect, tile, label, plane, parallax, delta, hidden, visible);
    if (layer) layers.push(layer);
  };
  tile.planes.forEach((plane, label) => add(label, plane, maps[label]));
  if (tile.backstop) add(-1, tile.backstop, planeMap(scene, rect, tile.backstop, rect));
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

function hiddenMask(scene, { rect, labels }, label, plane, delta, visible, surface) {
  const hidden = new Uint8Array(labels.length);
  let any = false;
  let step = 0;
  for (let i = 0; i < hidden.length; i++) {
    if (labels[i] !== label && delta[i] < visible[i] && delta[i] >= 0) {
      hidden[i] = 1;
      any = true;
      step = Math.max(step, visible[i] - delta[i]);
    }
  }
  if (!any) return hidden;
  const { px, py } = parallaxOf(scene, rect);
  const reach = (parallax, by) => Math.ceil(Math.min(by * parallax + MARGIN, MAX_REACH));
  const win = grown(rect, reach(px, step), reach(py, step), scene);
  const over = planeMap(scene, rect, plane, win);
  const open = new Uint8Array(win.w * win.h);
  let nearest = 0;
  let least = Infinity;
  for (let y = 0, i = 0; y < win.h; y++) {
    const from = (win.y + y) * scene.width + win.x;
    for (let x = 0; x < win.w; x++, i++) {
      const d = surface[from + x];
      const q = over[i];
      if (d <= q + OPEN) open[i] = 1;
      if (d > nearest) nearest = d;
      if (q < least) least = q;
    }
  }
  const most = Math.max(nearest - Math.max(least, 0), step);
  const near = dilated(open, win.w, win.h, reach(px, most), reach(py, most));
  for (let y = 0, i = 0; y < rect.h; y++) {
    const from = (rect.y - win.y + y) * win.w + rect.x - win.x;
    for (let x = 0; x < rect.w; x++, i++) if (!near[from + x]) hidden[i] = 0;
  }
  return hidden;
}

/** Box dilation by `rx`, `ry` pixels. */
function dilated(mask, w, h, rx, ry) {
  const rows = new Uint8Array(mask.length);
  for (let y = 0; y < h; y++) {
    let done = 0;
    for (let x = 0; x < w; x++) {
      if (!mask[y * w + x]) continue;
      const end = Math.min(x + rx + 1, w);
      rows.fill(1, y * w + Math.min(Math.max(x - rx, done), end), y * w + end);
      done = end;
    }
  }
  const out = new Uint8Array(mask.length);
  const until = new Int32Array(w);
  for (let y = 0; y < h; y++) {
    for (let x = 0; x < w; x++) {
      if (rows[y * w + x]) until[x] = y + ry + 1;
      if (y < until[x]) out[y * w + x] = 1;
    }
  }
  until.fill(h);
  for (let y = h - 1; y >= 0; y--) {
    for (let x = 0; x < w; x++) {
      if (rows[y * w + x]) until[x] = Math.max(y - ry, 0);
      if (y >= until[x]) out[y * w + x] = 1;
    }
  }
  return out;
}

/** Visible, hidden and soft texels of a layer, cut to its bounds; null where nothing is left. */
function shape(rect, { labels }, label, plane, parallax, delta, hidden, visible) {
  const { w, h } = rect;
  const classes = new Uint8Array(labels.length);
  const alpha = new Uint8Array(labels.length);
  let any = false;
  for (let i = 0; i < classes.length; i++) {
    const kind = labels[i] === label ? PHOTO : hidden[i] ? HIDDEN : EMPTY;
    if (kind === EMPTY) continue;
    classes[i] = kind;
    alpha[i] = 255;
    any = true;
  }
  if (!any) return null;
  if (label >= 0) soften(classes, alpha, w, h, parallax, delta, visible);
  const b = bounds(classes, w, h);
  const cut = (from) => {
    const out = new Uint8Array(b.w * b.h);
    for (let y = 0; y < b.h; y++) out.set(from.subarray((b.y + y) * w + b.x, (b.y + y) * w + b.x + b.w), y * b.w);
    return out;
  };
  return { plane, x: rect.x + b.x, y: rect.y + b.y, w: b.w, h: b.h, classes: cut(classes), alpha: cut(alpha) };
}

/** One ring of soft texels outside, where the layer lies in front; opaque where it is hardly so. */
function soften(classes, alpha, w, h, parallax, delta, visible) {
  const opaque = alpha.map((a) => (a === 255 ? 1 : 0));
  for (let y = 0; y < h; y++) {
    for (let x = 0; x < w; x++) {
      const at = y * w + x;
      const front = (delta[at] - visible[at]) * parallax;
      if (opaque[at] || !(front > 0)) continue;
      let set = 0;
      let all = 0;
      for (let v = Math.max(y - 1, 0); v < Math.min(y + 2, h); v++) {
        for (let u = Math.max(x - 1, 0); u < Math.min(x + 2, w); u++) {
          all++;
          set += opaque[v * w + u];
        }
      }
      if (!set) continue;
      classes[at] = PHOTO;
      alpha[at] = front <= SEAM ? 255 : Math.floor((255 * set + (all >> 1)) / all);
    }
  }
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

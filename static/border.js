// Continues a scene beyond the photo's borders by its mirror image, so that no camera of the view box sees past them. The rule is
// that of src/render/border.rs: the scene is mirrored, not the picture, so the continuation moves as the photo does.
import { extrinsics, lookingAt } from './camera.js';

/** The widest margin, as a share of the photo's longer side. */
const WIDEST = 1 / 8;

/**
 * The parts of layers that are drawn: each layer at its own place first, then what is mirrored beyond the borders.
 * @returns {{layer: number, x: number, y: number, w: number, h: number, left: number, right: number, upper: number, lower: number,
 *   u: number, v: number, flipX: boolean, flipY: boolean, a: number, b: number, c: number, cx: number, cy: number}[]} place in
 *   reference pixels, from and to where it is drawn in texels from its upper left corner, first column and row taken of the layer,
 *   its plane and the origin of the plane's coordinates
 */
export function pieces(scene) {
  const { layers } = scene;
  const margin = margins(scene);
  const half = scene.tileSize / 2;
  const out = [];
  for (let i = 0; i < layers.count; i++) {
    const columns = sides(layers.x[i], layers.w[i], drawn(scene, layers.tileX[i], layers.x[i], layers.w[i], scene.width), scene.width, margin.x);
    const rows = sides(layers.y[i], layers.h[i], drawn(scene, layers.tileY[i], layers.y[i], layers.h[i], scene.height), scene.height, margin.y);
    for (const y of rows) {
      for (const x of columns) {
        const [flipX, flipY] = [x.mirror !== null, y.mirror !== null];
        const centre = [layers.tileX[i] + half, layers.tileY[i] + half];
        out.push({
          layer: i,
          x: x.at,
          y: y.at,
          w: x.size,
          h: y.size,
          left: x.drawn[0],
          right: x.drawn[1],
          upper: y.drawn[0],
          lower: y.drawn[1],
          u: x.first,
          v: y.first,
          flipX,
          flipY,
          a: layers.a[i],
          b: flipX ? -layers.b[i] : layers.b[i],
          c: flipY ? -layers.c[i] : layers.c[i],
          cx: flipX ? x.mirror - centre[0] : centre[0],
          cy: flipY ? y.mirror - centre[1] : centre[1],
        });
      }
    }
  }
  return out;
}

/** From and to where `from..from + size` of a tile that starts at `tile` is drawn, on an axis of `length` pixels: `Grid::drawn`. */
function drawn({ tileSize, tileStride }, tile, from, size, length) {
  const overlap = tileSize - tileStride;
  const by = overlap < 2 ? 0 : overlap < 8 ? 0.5 : 1.5;
  const end = Math.min(tile + tileSize, length);
  const [first, last] = [tile > 0 ? tile + by : 0, end < length ? end - by : end];
  return [Math.max(first - from, 0), Math.min(last - from, size)];
}

/**
 * A range of an axis, drawn from `start` to `stop`: itself, and its parts within `margin` of either end mirrored there; `mirror` is
 * twice the mirror's place. Those of which anything is drawn.
 */
function sides(from, size, [start, stop], length, margin) {
  const end = from + size;
  const out = [{ at: from, size, first: 0, drawn: [start, stop], mirror: null }];
  // what is drawn of `n` texels from `first` on, seen from the other end
  const back = (first, n) => [stop, start].map((v) => n - Math.min(Math.max(v - first, 0), n));
  const low = Math.min(end, margin) - from;
  if (low > 0) out.push({ at: -(from + low), size: low, first: 0, drawn: back(0, low), mirror: 0 });
  const first = Math.max(from, length - margin) - from;
  if (size > first) out.push({ at: 2 * length - end, size: size - first, first, drawn: back(first, size - first), mirror: 2 * length });
  return out.filter((side) => side.drawn[0] < side.drawn[1]);
}

/**
 * Pixels by which the corners of the view box see past the photo's borders, and the share of the box that the widest margin allows.
 * @returns {{x: number, y: number, share: number}}
 */
export function margins({ width: w, height: h, intrinsics: k, viewBox: box }) {
  const past = [0, 0];
  for (let corner = 0; corner < 8; corner++) {
    const side = (bit, extent) => ((corner >> bit) & 1 ? -extent : extent);
    for (const pivot of [0, 1]) {
      const e = extrinsics(lookingAt(pivot, side(0, box.x), side(1, box.y), side(2, box.z)));
      for (const delta of [0, 1]) {
        const m = inverted(e.r.map((v, i) => (i % 3 === 2 ? v + e.t[(i - 2) / 3] * delta : v)));
        for (const [x, y] of [[0, 0], [w, 0], [0, h], [w, h]]) {
          const q = [(x - k.cx) / k.fx, (y - k.cy) / k.fy, 1];
          const p = [0, 3, 6].map((i) => m[i] * q[0] + m[i + 1] * q[1] + m[i + 2] * q[2]);
          const at = p[2] > 0 ? [(k.fx * p[0]) / p[2] + k.cx, (k.fy * p[1]) / p[2] + k.cy] : [Infinity, Infinity];
          past[0] = Math.max(past[0], -at[0], at[0] - w);
          past[1] = Math.max(past[1], -at[1], at[1] - h);
        }
      }
    }
  }
  const widest = Math.max(w, h) * WIDEST;
  // a pixel for rounding, and one because a piece ends at its last texel
  const bounded = (v, length) => (v > 0 ? Math.floor(Math.min(Math.min(v, widest) + 2, length)) : 0);
  return { x: bounded(past[0], w), y: bounded(past[1], h), share: Math.min(1, widest / past[0] || 1, widest / past[1] || 1) };
}

/** How far the camera goes: the view box, or as much of it as does not see past the continued border. */
export function limitsOf(head) {
  const { x, y, z } = head.viewBox;
  const { share } = margins(head);
  return { x: x * share, y: y * share, z: z * share };
}

/** Inverse of a row-major 3×3 matrix by cofactors. */
function inverted(m) {
  const c = (i, j) => {
    const [a, b, p, q] = [(i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3];
    return m[a * 3 + p] * m[b * 3 + q] - m[a * 3 + q] * m[b * 3 + p];
  };
  const det = m[0] * c(0, 0) + m[1] * c(0, 1) + m[2] * c(0, 2);
  return [0, 1, 2].flatMap((i) => [0, 1, 2].map((j) => c(j, i) / det));
}

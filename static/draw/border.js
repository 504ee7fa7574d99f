// Continues a scene beyond the photo's borders, so that no camera in the view box sees past them. As in crates/render/src/border.rs, the
// shape of the scene is mirrored, so that the continuation moves with the photo. Its colours are those at the border, blurred more with the
// distance: of a photo, the decoder computes them; of a room, the shader, from the border's means.
import { margins } from '../view/camera-limits.js';

/** @import { Layers, SceneHead } from '../decode/scene.js' */

/**
 * A drawn part of a layer: its rectangle in reference pixels (`x` to `h`), the drawn range in texels from its upper left corner (`left` to
 * `lower`), its first column and row in the layer (`u`, `v`), whether these run backward, its plane, and the origin of the plane's coordinates.
 * @typedef {{layer: number, x: number, y: number, w: number, h: number, left: number, right: number, upper: number, lower: number,
 *   u: number, v: number, flipX: boolean, flipY: boolean, a: number, b: number, c: number, cx: number, cy: number}} Piece
 */

/**
 * Splits layers into drawn parts: for each layer, first itself, then its mirror images beyond the borders.
 * @param {SceneHead & {layers: Layers}} scene
 * @returns {Piece[]}
 */
export function pieces(scene) {
  const { layers } = scene;
  const margin = margins(scene);
  const half = scene.tileSize / 2;
  const out = [];
  for (let i = 0; i < layers.count; i++) {
    const columns = sides(
      layers.x[i],
      layers.w[i],
      drawn(scene, layers.tileX[i], layers.x[i], layers.w[i], scene.width),
      scene.width,
      margin.x,
    );
    const rows = sides(
      layers.y[i],
      layers.h[i],
      drawn(scene, layers.tileY[i], layers.y[i], layers.h[i], scene.height),
      scene.height,
      margin.y,
    );
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
          cx: x.mirror !== null ? x.mirror - centre[0] : centre[0],
          cy: y.mirror !== null ? y.mirror - centre[1] : centre[1],
        });
      }
    }
  }
  return out;
}

/**
 * The borders at which a piece is mirrored, for the decoder: 1 columns, 2 rows, 4 at the right border, 8 at the lower one.
 * @param {Pick<Piece, 'x' | 'y' | 'flipX' | 'flipY'>} piece
 */
export function mirrorFlags({ x, y, flipX, flipY }) {
  return (flipX ? (x < 0 ? 1 : 5) : 0) + (flipY ? (y < 0 ? 2 : 10) : 0);
}

/**
 * The drawn range of `from..from + size` in a tile that starts at `tile`, on an axis of `length` pixels, as `Grid::drawn` in crates/core.
 * @param {Pick<SceneHead, 'tileSize' | 'tileStride'>} scene
 * @param {number} tile
 * @param {number} from
 * @param {number} size
 * @param {number} length
 */
function drawn({ tileSize, tileStride }, tile, from, size, length) {
  const overlap = tileSize - tileStride;
  const by = overlap < 2 ? 0 : overlap < 8 ? 0.5 : 1.5;
  const end = Math.min(tile + tileSize, length);
  const [first, last] = [tile > 0 ? tile + by : 0, end < length ? end - by : end];
  return [Math.max(first - from, 0), Math.min(last - from, size)];
}

/**
 * A range of an axis, drawn from `start` to `stop`, and the mirror images of its parts within `margin` of either end, without empty ones.
 * `mirror` is twice the position of the mirror.
 * @param {number} from
 * @param {number} size
 * @param {number[]} drawn
 * @param {number} length
 * @param {number} margin
 */
function sides(from, size, [start, stop], length, margin) {
  const end = from + size;
  /** @type {{at: number, size: number, first: number, drawn: number[], mirror: number | null}[]} */
  const out = [{ at: from, size, first: 0, drawn: [start, stop], mirror: null }];
  // the drawn range of `n` texels from `first` on, counted from the other end
  const back = (/** @type {number} */ first, /** @type {number} */ n) => [stop, start].map((v) => n - Math.min(Math.max(v - first, 0), n));
  const low = Math.min(end, margin) - from;
  if (low > 0) out.push({ at: -(from + low), size: low, first: 0, drawn: back(0, low), mirror: 0 });
  const first = Math.max(from, length - margin) - from;
  if (size > first) out.push({ at: 2 * length - end, size: size - first, first, drawn: back(first, size - first), mirror: 2 * length });
  return out.filter((side) => side.drawn[0] < side.drawn[1]);
}

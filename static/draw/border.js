// Continues a scene beyond the photo's borders by its mirror image, so that no camera of the view box sees past them. The rule is
// that of crates/render/src/border.rs: the scene is mirrored, not the picture, so the continuation moves as the photo does.
import { margins } from '../view/limits.js';

/** @import { Layers, SceneHead } from '../decode/scene.js' */

/**
 * A part of a layer that is drawn: place in reference pixels (`x` to `h`), from and to where it is drawn in texels from its upper left
 * corner, first column and row taken of the layer, whether these run backward, its plane and the origin of the plane's coordinates.
 * @typedef {{layer: number, x: number, y: number, w: number, h: number, left: number, right: number, upper: number, lower: number,
 *   u: number, v: number, flipX: boolean, flipY: boolean, a: number, b: number, c: number, cx: number, cy: number}} Piece
 */

/**
 * The parts of layers that are drawn: each layer at its own place first, then what is mirrored beyond the borders.
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
 * From and to where `from..from + size` of a tile that starts at `tile` is drawn, on an axis of `length` pixels: `Grid::drawn`.
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
 * A range of an axis, drawn from `start` to `stop`: itself, and its parts within `margin` of either end mirrored there; `mirror` is
 * twice the mirror's place. Those of which anything is drawn.
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
  // what is drawn of `n` texels from `first` on, seen from the other end
  const back = (/** @type {number} */ first, /** @type {number} */ n) => [stop, start].map((v) => n - Math.min(Math.max(v - first, 0), n));
  const low = Math.min(end, margin) - from;
  if (low > 0) out.push({ at: -(from + low), size: low, first: 0, drawn: back(0, low), mirror: 0 });
  const first = Math.max(from, length - margin) - from;
  if (size > first) out.push({ at: 2 * length - end, size: size - first, first, drawn: back(first, size - first), mirror: 2 * length });
  return out.filter((side) => side.drawn[0] < side.drawn[1]);
}

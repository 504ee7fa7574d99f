// Builds the instances that the shaders draw, in drawing order.
import { tileCounts } from '../decode/grid.js';

/** @import { Scene } from '../decode/scene.js' */
/** @import { Piece } from './border.js' */

/** Floats per instance, in the order of tmpi.wgsl. */
export const INSTANCE_FLOATS = 12;

/**
 * Instances: `opaque` of them for pass 1, then `soft` for pass 2 and as many in the order for a backward-looking camera. `tiles`: the tile
 * of each instance, numbered row by row.
 * @typedef {{data: Float32Array<ArrayBuffer>, tiles: Uint32Array<ArrayBuffer>, opaque: number, soft: number}} Instances
 */

/**
 * Builds the instances: first all pieces in layer order for pass 1, then those with a soft edge for pass 2, back to front by disparity at
 * the piece's centre, then these again in the order for a camera that looks backward.
 * @param {Pick<Scene, 'layers' | 'width' | 'height' | 'tileSize' | 'tileStride'>} scene
 * @param {Piece[]} pieces
 * @param {{page: ArrayLike<number>, atlasX: ArrayLike<number>, atlasY: ArrayLike<number>}} places of the pieces' upper left corners on the
 *   pages. For a mirrored piece that shares the layer's unmirrored texels: minus the right side (x) or the lower side (y), from which the
 *   texels run backward; the shader then takes the colours from the border's means
 * @returns {Instances}
 */
export function instances(scene, pieces, { page, atlasX, atlasY }) {
  const half = scene.tileSize / 2;
  const mean = pieces.map((p) => p.a + (p.b * (p.x + p.w / 2 - p.cx)) / half + (p.c * (p.y + p.h / 2 - p.cy)) / half);
  const softs = [...pieces.keys()].filter((i) => scene.layers.soft[pieces[i].layer]);
  const inOrder = (/** @type {number} */ sign) => softs.toSorted((i, j) => sign * (mean[i] - mean[j]) || i - j);
  const order = [...pieces.keys(), ...inOrder(1), ...inOrder(-1)];
  const data = new Float32Array(order.length * INSTANCE_FLOATS);
  const tiles = new Uint32Array(order.length);
  order.forEach((i, slot) => {
    const p = pieces[i];
    const rect = [p.x + p.left, p.y + p.upper, p.right - p.left, p.lower - p.upper];
    data.set([p.a, p.b, p.c, page[i], p.cx, p.cy, ...rect, atlasX[i] + p.left, atlasY[i] + p.upper], slot * INSTANCE_FLOATS);
    tiles[slot] = tileOf(scene, p.layer);
  });
  return { data, tiles, opaque: pieces.length, soft: softs.length };
}

/**
 * The same instances with the parallax error of each tile in pixels, row by row, for the overlay `error`.
 * @param {Instances} instances
 * @param {number[]} errors
 */
export function withErrors({ data, tiles, ...counts }, errors) {
  const out = data.slice();
  tiles.forEach((tile, slot) => {
    out[slot * INSTANCE_FLOATS + PAGE] += shareOf(errors[tile]);
  });
  return { data: out, tiles, ...counts };
}

/** Index of the page among the floats of an instance. */
const PAGE = 3;
/** Parallax error in pixels at the end of the colour scale. */
const MOST_PX = 1;

/**
 * Encodes an error as the fraction that is added to an instance's page.
 * @param {number} px
 */
function shareOf(px) {
  return px > 0 ? Math.min(px / MOST_PX, 1) * 0.999 : 0;
}

/**
 * Number of a layer's tile, row by row.
 * @param {Pick<Scene, 'layers' | 'width' | 'height' | 'tileSize' | 'tileStride'>} scene
 * @param {number} layer
 */
function tileOf(scene, layer) {
  const { layers, tileStride } = scene;
  const { columns } = tileCounts(scene);
  return Math.round(layers.tileY[layer] / tileStride) * columns + Math.round(layers.tileX[layer] / tileStride);
}

// The instances that the shaders draw, in their order.
import { tileCounts } from '../decode/grid.js';

/** @import { Scene } from '../decode/scene.js' */
/** @import { Piece } from './border.js' */

/** Floats of an instance; their order is that of tmpi.wgsl. */
export const INSTANCE_FLOATS = 12;

/**
 * Instances as the shaders take them: first all pieces in layer order for pass 1, then those with a soft edge for pass 2, back to
 * front by disparity at the piece's centre. `errors`: parallax error in pixels of each tile, row by row, for the overlay that shows it.
 * @param {Scene} scene
 * @param {Piece[]} pieces
 * @param {{page: Uint32Array, atlasX: Uint32Array, atlasY: Uint32Array}} places
 * @param {number[]} [errors]
 * @returns {{data: Float32Array, opaque: number, soft: number}} with the counts of both
 */
export function instances(scene, pieces, { page, atlasX, atlasY }, errors = []) {
  const half = scene.tileSize / 2;
  const mean = pieces.map((p) => p.a + (p.b * (p.x + p.w / 2 - p.cx)) / half + (p.c * (p.y + p.h / 2 - p.cy)) / half);
  const softs = [...pieces.keys()].filter((i) => scene.layers.soft[pieces[i].layer]).sort((i, j) => mean[i] - mean[j] || i - j);
  const data = new Float32Array((pieces.length + softs.length) * INSTANCE_FLOATS);
  const put = (i, slot) => {
    const p = pieces[i];
    const plane = [p.a, p.b, p.c, page[i] + shareOf(errors[tileOf(scene, p.layer)])];
    const rect = [p.x + p.left, p.y + p.upper, p.right - p.left, p.lower - p.upper];
    data.set([...plane, p.cx, p.cy, ...rect, atlasX[i] + p.left, atlasY[i] + p.upper], slot * INSTANCE_FLOATS);
  };
  pieces.forEach((_, i) => put(i, i));
  softs.forEach((i, k) => put(i, pieces.length + k));
  return { data, opaque: pieces.length, soft: softs.length };
}

/** Parallax error in pixels that is shown as the largest. */
const MOST_PX = 1;

/** An error as the fraction that an instance carries beside its page. */
function shareOf(px) {
  return px > 0 ? Math.min(px / MOST_PX, 1) * 0.999 : 0;
}

/** Number of a layer's tile, row by row. */
function tileOf(scene, layer) {
  const { layers, tileStride } = scene;
  const { columns } = tileCounts(scene);
  return Math.round(layers.tileY[layer] / tileStride) * columns + Math.round(layers.tileX[layer] / tileStride);
}

// Default motion range and pivot of a photo. All photos move by about the same share of their width, less if the depth is flat or broken
// up. The rules are those of crates/render/src/motion_range.rs.
import { tileCounts } from '../decode/grid.js';
import { deltaAt } from './camera.js';

/** @import { Offset, Scene, SceneHead } from '../decode/scene.js' */

/** Parallax between near and far things from one end of the travel to the other, as a share of the photo's width. */
const PARALLAX = 0.06;
/** Smallest and largest half extent of the travel, in units of the nearest distance, within the view box. */
const MIN_EXTENT = 0.02;
export const MAX_EXTENT = 0.06;
/** Quantiles of disparity that count as the far and the near end. */
const FAR = 0.03;
const NEAR = 0.97;
/** Layers per tile from which depth counts as broken up, the reduction for each further layer, and the smallest factor. */
const BROKEN_LAYERS = 4;
const LAYER_REDUCTION = 0.15;
const MIN_FACTOR = 0.6;
const BINS = 256;
/** Pivot and spread of disparities if only the head of a scene is known. */
const UNKNOWN = { pivot: 0.35, spread: 0.8 };

/**
 * `travel`: half extents of the camera's default range; `pivot`: the disparity that views rotate about, the median over the picture's area;
 * `nearest`: centre of the nearest things, as shares of width and height.
 * @typedef {{travel: Offset, pivot: number, nearest: {x: number, y: number}}} MotionRange
 */

/**
 * Computes the range of a scene, or a default if only its head is known.
 * @param {Scene | SceneHead} scene
 * @returns {MotionRange}
 */
export function motionRangeOf(scene) {
  const unknown = { travel: travelOf(scene, UNKNOWN.spread, 0), pivot: UNKNOWN.pivot, nearest: { x: 0.5, y: 0.5 } };
  if (!('layers' in scene)) return unknown;
  const { layers } = scene;
  const bins = new Uint16Array(layers.count);
  const area = new Float64Array(BINS);
  for (let i = 0; i < layers.count; i++) {
    const delta = deltaAt(scene, i, layers.x[i] + layers.w[i] / 2, layers.y[i] + layers.h[i] / 2);
    bins[i] = Math.min(BINS - 1, Math.max(0, Math.floor(delta * BINS)));
    area[bins[i]] += layers.visible[i];
  }
  const total = area.reduce((sum, v) => sum + v, 0);
  if (total === 0) return unknown;
  const quantile = (/** @type {number} */ share) => {
    let sum = 0;
    for (let bin = 0; bin < BINS; bin++) {
      sum += area[bin];
      if (sum >= share * total) return bin;
    }
    return BINS - 1;
  };
  const near = quantile(NEAR);
  const sums = [0, 0, 0];
  for (let i = 0; i < layers.count; i++) {
    if (bins[i] < near) continue;
    sums[0] += layers.visible[i];
    sums[1] += layers.visible[i] * (layers.x[i] + layers.w[i] / 2);
    sums[2] += layers.visible[i] * (layers.y[i] + layers.h[i] / 2);
  }
  const place = (/** @type {number} */ sum, /** @type {number} */ side) => (sums[0] > 0 ? sum / sums[0] / side : 0.5);
  return {
    travel: travelOf(scene, (near - quantile(FAR)) / BINS, layers.count / tileCounts(scene).tiles),
    pivot: (quantile(0.5) + 0.5) / BINS,
    nearest: { x: place(sums[1], scene.width), y: place(sums[2], scene.height) },
  };
}

/**
 * The travel for a spread of disparities and a mean count of layers per tile.
 * @param {SceneHead} head
 * @param {number} spread
 * @param {number} layers
 * @returns {Offset}
 */
function travelOf({ width, intrinsics, viewBox: { x, y, z } }, spread, layers) {
  const factor = Math.max(1 - LAYER_REDUCTION * Math.max(layers - BROKEN_LAYERS, 0), MIN_FACTOR);
  const wanted = ((PARALLAX * width) / (2 * intrinsics.fx * Math.max(spread, 1e-3))) * factor;
  const extent = Math.max(Math.min(wanted, MAX_EXTENT), MIN_EXTENT);
  return { x: Math.min(x, extent), y: Math.min(y, extent), z: Math.min(z, 2 * extent) };
}

/** Largest share of each side that is cropped while the camera is away from its home position. */
const MAX_CROP = 0.025;
/** Extent of idle motion as a share of the travel, rounded up a little. */
const IDLE = 0.8;

/**
 * Magnification of a photo while the camera is away from its home position, so that the area beyond the border stays out of view.
 * @param {SceneHead} head
 * @param {Offset} limits
 * @param {number} pivot
 */
export function overscan({ width, height, intrinsics: { fx, fy } }, limits, pivot) {
  const most = Math.max(pivot, 1 - pivot) * IDLE;
  const hidden = Math.max((most * fx * limits.x) / width, (most * fy * limits.y) / height);
  return 1 / (1 - 2 * Math.min(MAX_CROP, hidden));
}

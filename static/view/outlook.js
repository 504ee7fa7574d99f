// How far a photo moves where nobody says, and about what: so that each moves by about the same share of its width, little where its
// depth is flat or broken up. The rules are those of crates/render/src/outlook.rs.
import { tileCounts } from '../decode/grid.js';
import { deltaAt } from './camera.js';

/** @import { Offset, Scene, SceneHead } from '../decode/scene.js' */

/** Way of near things against far ones between the ends of the travel, as a share of the photo's width. */
const SHARE = 0.06;
/** Half extents of the travel, in units of the nearest distance: the least and the most where the view box has them. */
const LEAST = 0.02;
export const MOST = 0.06;
/** Shares of the photo that lie beyond what is taken for its far and its near end. */
const FAR = 0.03;
const NEAR = 0.97;
/** Layers a tile from which on depth counts as broken up, how much less each further one moves it, and how much at least. */
const BROKEN = 4;
const CALMER = 0.15;
const CALMEST = 0.6;
const BINS = 256;
/** Pivot and spread of disparities where only the head of a scene is known. */
const UNKNOWN = { pivot: 0.35, spread: 0.8 };

/**
 * What a scene's disparities say about moving it: half extents of where the camera goes by itself, the disparity that views turn
 * about, which is that at the middle of the picture's area, and where the nearest things are, as shares of width and height.
 * @typedef {{travel: Offset, pivot: number, nearest: {x: number, y: number}}} Outlook
 */

/**
 * Looks over a scene, or what is known of it.
 * @param {Scene | SceneHead} scene
 * @returns {Outlook}
 */
export function outlookOf(scene) {
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
 * The travel of a scene whose disparities spread over `spread`, of so many layers a tile.
 * @param {SceneHead} head
 * @param {number} spread
 * @param {number} layers
 * @returns {Offset}
 */
function travelOf({ width, intrinsics, viewBox: { x, y, z } }, spread, layers) {
  const calm = Math.max(1 - CALMER * Math.max(layers - BROKEN, 0), CALMEST);
  const wanted = ((SHARE * width) / (2 * intrinsics.fx * Math.max(spread, 1e-3))) * calm;
  const extent = Math.max(Math.min(wanted, MOST), LEAST);
  return { x: Math.min(x, extent), y: Math.min(y, extent), z: Math.min(z, 2 * extent) };
}

/** Most of each side that is left out where the camera is away from its place. */
const MOST_HIDDEN = 0.025;
/** How far idle motion goes of the travel, a little rounded up. */
const IDLE = 0.8;

/**
 * How much larger a photo is shown while the camera is away from its place, so that what lies beyond its border stays out of sight.
 * @param {SceneHead} head
 * @param {Offset} limits
 * @param {number} pivot
 */
export function overscan({ width, height, intrinsics: { fx, fy } }, limits, pivot) {
  const most = Math.max(pivot, 1 - pivot) * IDLE;
  const hidden = Math.max((most * fx * limits.x) / width, (most * fy * limits.y) / height);
  return 1 / (1 - 2 * Math.min(MOST_HIDDEN, hidden));
}

// The uniform `View` of tmpi.wgsl, for both backends.
import { extrinsics } from '../view/camera.js';

/** @import { Scene } from '../decode/scene.js' */
/** @import { View } from '../view/camera.js' */

/** Vertices of an instance, as in tmpi.wgsl. */
export const VERTICES = 18;
/** The mask of a view that draws all colour channels. */
export const ALL = 7;
/** Size of the uniform, bytes. */
export const UNIFORM_BYTES = 112;

/**
 * The uniform of a view. `near` returns the reciprocal of the largest target disparity that is drawn, for the camera's translation;
 * `overlay` is an index into `OVERLAYS` (view/draw-mode.js).
 * @param {Scene} scene
 * @param {View} view
 * @param {(t: number[]) => number} near
 * @param {number} overlay
 */
export function viewUniform(scene, { pose, k, width, height }, near, overlay) {
  const { intrinsics, tileSize, atlas } = scene;
  const { r, t } = extrinsics(pose);
  const sizes = [scene.width, scene.height, atlas.width];
  const column = (/** @type {number} */ j) => [r[j], r[3 + j], r[6 + j], sizes[j]];
  const camera = (/** @type {typeof k} */ c) => [c.fx, c.fy, c.cx, c.cy];
  const rest = [...t, near(t), ...camera(intrinsics), ...camera(k), width, height, tileSize / 2, overlay];
  return new Float32Array([...column(0), ...column(1), ...column(2), ...rest]);
}

/**
 * Whether a camera looks in the opposite direction to the reference camera, so that rays meet the planes in reverse order.
 * @param {View} view
 */
export function looksBackward({ pose }) {
  return extrinsics(pose).r[8] < 0;
}

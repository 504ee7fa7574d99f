// The uniform at the head of tmpi.wgsl, which both backends fill in.
import { extrinsics } from '../view/camera.js';

/** @import { Scene } from '../decode/scene.js' */
/** @import { View } from '../view/camera.js' */

/** Vertices of an instance, as in tmpi.wgsl. */
export const VERTICES = 18;
/** Size of the uniform. */
export const UNIFORM_BYTES = 112;

/**
 * The uniform of a view. `near` gives the reciprocal of the greatest target disparity that is drawn, for the camera's translation;
 * `overlay` is the place of one in `OVERLAYS` (view/display.js).
 * @param {Scene} scene
 * @param {View} view
 * @param {(t: number[]) => number} near
 * @param {number} overlay
 */
export function viewUniform({ intrinsics, tileSize }, { pose, k, width, height }, near, overlay) {
  const { r, t } = extrinsics(pose);
  const column = (/** @type {number} */ j) => [r[j], r[3 + j], r[6 + j], 0];
  const camera = (/** @type {typeof k} */ c) => [c.fx, c.fy, c.cx, c.cy];
  const rest = [...t, near(t), ...camera(intrinsics), ...camera(k), width, height, tileSize / 2, overlay];
  return new Float32Array([...column(0), ...column(1), ...column(2), ...rest]);
}

/**
 * True where a camera looks against the photo's own: rays meet the planes in the opposite order.
 * @param {View} view
 */
export function looksBackward({ pose }) {
  return extrinsics(pose).r[8] < 0;
}

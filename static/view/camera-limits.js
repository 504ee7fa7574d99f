// Limits of the camera: the view box, reduced so that no view sees past the continued border (draw/border.js).
import { extrinsics, lookingAt } from './camera.js';

/** @import { SceneHead } from '../decode/scene.js' */

/** The widest margin, as a share of the photo's longer side. */
const MAX_MARGIN = 1 / 4;

/**
 * Pixels by which views from the corners of the view box see past the photo's borders, and the share of the box that the widest margin
 * allows.
 * @param {SceneHead} head
 * @returns {{x: number, y: number, share: number}}
 */
export function margins({ width: w, height: h, intrinsics: k, viewBox: box }) {
  const beyond = [0, 0];
  for (let corner = 0; corner < 8; corner++) {
    const side = (/** @type {number} */ bit, /** @type {number} */ extent) => ((corner >> bit) & 1 ? -extent : extent);
    for (const pivot of [0, 1]) {
      const e = extrinsics(lookingAt(pivot, side(0, box.x), side(1, box.y), side(2, box.z)));
      for (const delta of [0, 1]) {
        const m = inverted(e.r.map((v, i) => (i % 3 === 2 ? v + e.t[(i - 2) / 3] * delta : v)));
        for (const [x, y] of [
          [0, 0],
          [w, 0],
          [0, h],
          [w, h],
        ]) {
          const q = [(x - k.cx) / k.fx, (y - k.cy) / k.fy, 1];
          const p = [0, 3, 6].map((i) => m[i] * q[0] + m[i + 1] * q[1] + m[i + 2] * q[2]);
          const at = p[2] > 0 ? [(k.fx * p[0]) / p[2] + k.cx, (k.fy * p[1]) / p[2] + k.cy] : [Infinity, Infinity];
          beyond[0] = Math.max(beyond[0], -at[0], at[0] - w);
          beyond[1] = Math.max(beyond[1], -at[1], at[1] - h);
        }
      }
    }
  }
  const maxMargin = Math.max(w, h) * MAX_MARGIN;
  // one pixel for rounding, one because a piece ends at its last texel
  const bounded = (/** @type {number} */ v, /** @type {number} */ length) =>
    v > 0 ? Math.floor(Math.min(Math.min(v, maxMargin) + 2, length)) : 0;
  return { x: bounded(beyond[0], w), y: bounded(beyond[1], h), share: Math.min(1, maxMargin / beyond[0] || 1, maxMargin / beyond[1] || 1) };
}

/**
 * Half extents of the camera's range: the view box, reduced so that no view sees past the continued border.
 * @param {SceneHead} head
 */
export function limitsOf(head) {
  const { x, y, z } = head.viewBox;
  const { share } = margins(head);
  return { x: x * share, y: y * share, z: z * share };
}

/**
 * Inverse of a row-major 3×3 matrix by cofactors.
 * @param {number[]} m
 */
function inverted(m) {
  const c = (/** @type {number} */ i, /** @type {number} */ j) => {
    const [a, b, p, q] = [(i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3];
    return m[a * 3 + p] * m[b * 3 + q] - m[a * 3 + q] * m[b * 3 + p];
  };
  const det = m[0] * c(0, 0) + m[1] * c(0, 1) + m[2] * c(0, 2);
  return [0, 1, 2].flatMap((i) => [0, 1, 2].map((j) => c(j, i) / det));
}

// Camera paths for films. Each path is closed, so that a film can loop.
import { lookingAt, resized } from '../view/camera.js';
import { overscan } from '../view/motion-range.js';

/** @import { Offset, SceneHead } from '../decode/scene.js' */

/** Names of the paths: those of idle motion, and a wigglegram, which jumps between the views of a camera with three lenses. */
export const STYLES = Object.freeze(['swing', 'orbit', 'dolly', 'dolly-zoom', 'zoom', 'wiggle']);
/** Extent of the paths, as a share of the camera's limits. */
const EXTENT = 0.8;
/** Magnification of the lens at the end of `zoom`. */
const ZOOM = 1.3;
/** Positions of a wigglegram, shares of EXTENT. */
const WIGGLE = [-1, 0, 1, 0];
/** Duration of each position, seconds. */
export const WIGGLE_S = 0.12;

/**
 * The camera at a point of a path.
 * @param {string} style one of STYLES
 * @param {number} share position along the path, 0 to 1; both ends are the same point
 * @returns {{place: Offset, magnified: number, compensated: number}} `place`: offset in units of the limits; `magnified`: magnification of
 *   the lens; `compensated`: share of a move forward or back that the lens compensates for
 */
export function pathAt(style, share) {
  const turn = 2 * Math.PI * share;
  const [sin, cos] = [EXTENT * Math.sin(turn), EXTENT * Math.cos(turn)];
  const out = (1 - Math.cos(turn)) / 2;
  const at = (x = 0, y = 0, z = 0, magnified = 1, compensated = 0) => ({ place: { x, y, z }, magnified, compensated });
  if (style === 'swing') return at(sin, 0.4 * EXTENT * Math.sin(2 * turn));
  if (style === 'orbit') return at(sin, cos);
  if (style === 'dolly') return at(0, 0, sin);
  if (style === 'dolly-zoom') return at(0, 0, -out, 1, 1);
  if (style === 'zoom') return at(0, 0, out, 1 + (ZOOM - 1) * out);
  if (style === 'wiggle') return at(EXTENT * WIGGLE[Math.floor(share * WIGGLE.length) % WIGGLE.length]);
  throw new Error(`unknown path ${style}`);
}

/**
 * The camera of a frame.
 * @param {{head: SceneHead, limits: Offset, pivot: number}} scene
 * @param {ReturnType<typeof pathAt>} point
 * @param {{width: number, height: number}} size of the picture, pixels
 */
export function cameraAt({ head, limits, pivot }, { place, magnified, compensated }, size) {
  const pose = lookingAt(pivot, place.x * limits.x, place.y * limits.y, place.z * limits.z);
  const scale = overscan(head, limits, pivot) * magnified * (1 - compensated * pose.tz * pivot);
  // rounding changes the aspect ratio by up to a pixel: crop the excess instead of stretching
  const fill = Math.max(1, (size.height * head.width) / (size.width * head.height));
  const { fx, fy, cx, cy } = resized(head.intrinsics, head, size);
  const zoom = scale * fill;
  const [x, y] = [size.width / 2, size.height / 2];
  return { pose, k: { fx: fx * zoom, fy: fy * zoom, cx: x + (cx - x) * zoom, cy: y + (cy - y) * zoom } };
}

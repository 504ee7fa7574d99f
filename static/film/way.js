// Ways of the camera in a film. Each ends where it begins, so that a film can go on for ever.
import { lookingAt, resized } from '../view/camera.js';

/** @import { Offset, SceneHead } from '../decode/scene.js' */

/** Ways by name: those of idle motion, and a wigglegram, which jumps between three places as a camera of three lenses sees. */
export const STYLES = Object.freeze(['swing', 'orbit', 'dolly', 'dolly-zoom', 'zoom', 'wiggle']);
/** How far they go, a share of what the camera may. */
const FAR = 0.8;
/** How much the border is cut away, so that what is mirrored beyond it stays out of the picture. */
const OVERSCAN = 1.04;
/** How much narrower the lens looks at the end of `zoom`. */
const ZOOM = 1.3;
/** Places of a wigglegram, shares of FAR. */
const WIGGLE = [-1, 0, 1, 0];
/** How long each of them is shown, seconds. */
export const WIGGLE_S = 0.12;

/**
 * Where the camera is at a share of the way: an offset in units of its limits, how much larger the lens shows the photo, and how much
 * of a step forward or back the lens makes up for.
 * @param {string} style one of STYLES
 * @param {number} share 0 to 1, which are the same
 * @returns {{place: Offset, magnified: number, compensated: number}}
 */
export function wayAt(style, share) {
  const turn = 2 * Math.PI * share;
  const [sin, cos] = [FAR * Math.sin(turn), FAR * Math.cos(turn)];
  const way = (1 - Math.cos(turn)) / 2;
  const at = (x = 0, y = 0, z = 0, magnified = 1, compensated = 0) => ({ place: { x, y, z }, magnified, compensated });
  if (style === 'swing') return at(sin, 0.4 * FAR * Math.sin(2 * turn));
  if (style === 'orbit') return at(sin, cos);
  if (style === 'dolly') return at(0, 0, sin);
  if (style === 'dolly-zoom') return at(0, 0, -way, 1, 1);
  if (style === 'zoom') return at(0, 0, way, 1 + (ZOOM - 1) * way);
  if (style === 'wiggle') return at(FAR * WIGGLE[Math.floor(share * WIGGLE.length) % WIGGLE.length]);
  throw new Error(`there is no way ${style}`);
}

/**
 * The camera of a frame.
 * @param {{head: SceneHead, limits: Offset, pivot: number}} scene
 * @param {ReturnType<typeof wayAt>} way
 * @param {{width: number, height: number}} size of the picture, pixels
 */
export function cameraAt({ head, limits, pivot }, { place, magnified, compensated }, size) {
  const pose = lookingAt(pivot, place.x * limits.x, place.y * limits.y, place.z * limits.z);
  const scale = OVERSCAN * magnified * (1 - compensated * pose.tz * pivot);
  // the photo's own shape is kept to a pixel; what is over is cut, not stretched
  const fill = Math.max(1, (size.height * head.width) / (size.width * head.height));
  const { fx, fy, cx, cy } = resized(head.intrinsics, head, size);
  const by = scale * fill;
  const [x, y] = [size.width / 2, size.height / 2];
  return { pose, k: { fx: fx * by, fy: fy * by, cx: x + (cx - x) * by, cy: y + (cy - y) * by } };
}

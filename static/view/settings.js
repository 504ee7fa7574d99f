// The owner's settings of a photo, stored by the server: range of motion, pivot, start position and more.

/** @import { Offset } from '../decode/scene.js' */

/**
 * @typedef {object} Settings
 * @property {number} [version]
 * @property {string} [title]
 * @property {Offset} [motion] range of motion, as shares of the view box
 * @property {number} [focus] disparity that views rotate about
 * @property {Offset} [start] start position of the camera in the view box
 * @property {string} [idle] style of idle motion, one of `STYLES` (input/camera-motion.js), or `none`
 * @property {number} [speed] speed factor
 * @property {'private' | 'link'} [visibility] who may see it, on servers with authentication
 * @property {Offset} [poster] camera position of the preview image in lists
 */

/** @type {Settings} */
const NONE = Object.freeze({});

/**
 * The settings in a photo's state; none if their version is unknown.
 * @param {{settings?: Settings} | null | undefined} state
 */
export function settingsOf(state) {
  return state?.settings?.version === 1 ? state.settings : NONE;
}

/**
 * Range of motion: that of the settings, otherwise the photo's default.
 * @param {Settings} settings
 * @param {Offset} defaults default, as shares of the view box
 * @returns {Offset}
 */
export function sharesOf({ motion }, defaults) {
  return motion ? { ...motion } : defaults;
}

/**
 * Converts a position in the view box to an offset in units of the limits, clamped to them.
 * @param {Offset} place
 * @param {Offset} shares
 */
export function offsetOf(place, shares) {
  const clamp = (/** @type {number} */ v, /** @type {number} */ most) => (most > 0 ? Math.max(-1, Math.min(1, v / most)) : 0);
  return { x: clamp(place.x, shares.x), y: clamp(place.y, shares.y), z: clamp(place.z, shares.z) };
}

/**
 * Converts an offset in units of the limits to a position in the view box.
 * @param {Offset} offset
 * @param {Offset} shares
 */
export function placeOf(offset, shares) {
  return { x: offset.x * shares.x, y: offset.y * shares.y, z: offset.z * shares.z };
}

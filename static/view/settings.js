// What the owner of a photo wants of viewers, as the server keeps it: how far the camera goes, what stays in place, where it starts.

/** @import { Offset } from '../decode/scene.js' */

/**
 * @typedef {object} Settings
 * @property {number} [version]
 * @property {string} [title]
 * @property {Offset} [motion] shares of the view box that the camera goes
 * @property {number} [focus] disparity that views turn about
 * @property {Offset} [start] where the camera starts, in the view box
 * @property {Offset} [poster] where the picture of the list is taken from
 */

/** @type {Settings} */
const NONE = Object.freeze({});

/**
 * Settings of a photo's state; of a version that is not known, none.
 * @param {{settings?: Settings} | null | undefined} state
 */
export function settingsOf(state) {
  return state?.settings?.version === 1 ? state.settings : NONE;
}

/**
 * The camera's limits, less where the settings say so.
 * @param {Offset} limits
 * @param {Settings} settings
 */
export function limited({ x, y, z }, { motion }) {
  return motion ? { x: x * motion.x, y: y * motion.y, z: z * motion.z } : { x, y, z };
}

/**
 * A place in the view box as an offset within the limits that `motion` leaves of it.
 * @param {Offset} place
 * @param {Settings} settings
 */
export function offsetOf(place, { motion }) {
  const within = (/** @type {number} */ v, /** @type {number} */ most) => (most > 0 ? Math.max(-1, Math.min(1, v / most)) : 0);
  return motion ? { x: within(place.x, motion.x), y: within(place.y, motion.y), z: within(place.z, motion.z) } : { ...place };
}

/**
 * The reverse: where in the view box an offset is.
 * @param {Offset} offset
 * @param {Settings} settings
 */
export function placeOf(offset, { motion }) {
  return motion ? { x: offset.x * motion.x, y: offset.y * motion.y, z: offset.z * motion.z } : { ...offset };
}

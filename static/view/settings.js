// What the owner of a photo wants of viewers, as the server keeps it: how far the camera goes, what stays in place, where it starts.

/** @import { Offset } from '../decode/scene.js' */

/**
 * @typedef {object} Settings
 * @property {number} [version]
 * @property {string} [title]
 * @property {Offset} [motion] shares of the view box that the camera goes
 * @property {number} [focus] disparity that views turn about
 * @property {Offset} [start] where the camera starts, in the view box
 * @property {string} [idle] how it moves by itself, one of `STYLES` (input/motion.js), or `none`
 * @property {number} [speed] times the usual
 * @property {'private' | 'link'} [visibility] who may see it, where the server asks who comes
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
 * What the camera goes of a view box: what the settings say, else what the photo itself does.
 * @param {Settings} settings
 * @param {Offset} usual shares of the view box
 * @returns {Offset}
 */
export function sharesOf({ motion }, usual) {
  return motion ? { ...motion } : usual;
}

/**
 * A place in the view box as an offset within the limits that `shares` leave of it.
 * @param {Offset} place
 * @param {Offset} shares
 */
export function offsetOf(place, shares) {
  const within = (/** @type {number} */ v, /** @type {number} */ most) => (most > 0 ? Math.max(-1, Math.min(1, v / most)) : 0);
  return { x: within(place.x, shares.x), y: within(place.y, shares.y), z: within(place.z, shares.z) };
}

/**
 * The reverse: where in the view box an offset is.
 * @param {Offset} offset
 * @param {Offset} shares
 */
export function placeOf(offset, shares) {
  return { x: offset.x * shares.x, y: offset.y * shares.y, z: offset.z * shares.z };
}

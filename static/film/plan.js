// What a film is to be: its pictures' size and times.
import { WIGGLE_S } from './way.js';

/**
 * @typedef {{kind: 'mp4' | 'webm' | 'gif', style: string, seconds: number, side: number}} Wish `side`: of the longer side, pixels
 * @typedef {{width: number, height: number, times: number[], frameMs: number, turns: number}} Plan `times`: shares of all the way at which a
 *   frame is taken, each shown for `frameMs`; `turns`: how often the way is gone
 */

/** Milliseconds of a frame. GIF counts hundredths of a second, and browsers slow down what is faster than 20 ms. */
const VIDEO_MS = 1000 / 30;
const GIF_MS = 60;
/** About how long a turn takes, seconds. */
const TURN_S = 4;

/**
 * @param {Wish} wish
 * @param {{width: number, height: number}} photo
 * @returns {Plan}
 */
export function planOf({ kind, style, seconds, side }, photo) {
  const scale = Math.min(1, side / Math.max(photo.width, photo.height));
  // video codecs halve the resolution of colour
  const step = kind === 'gif' ? 1 : 2;
  const pixels = (/** @type {number} */ v) => Math.max(step, Math.round((v * scale) / step) * step);
  const [width, height] = [pixels(photo.width), pixels(photo.height)];
  if (style === 'wiggle') {
    const frameMs = WIGGLE_S * 1000;
    // a GIF repeats itself
    const turns = kind === 'gif' ? 1 : Math.max(1, Math.round(seconds / (4 * WIGGLE_S)));
    return { width, height, times: evenly(4 * turns), frameMs, turns };
  }
  const frameMs = kind === 'gif' ? GIF_MS : VIDEO_MS;
  const turns = Math.max(1, Math.round(seconds / TURN_S));
  // the turns of a GIF are alike: one is enough
  const length = kind === 'gif' ? seconds / turns : seconds;
  return { width, height, times: evenly(Math.max(2, Math.round((length * 1000) / frameMs))), frameMs, turns: kind === 'gif' ? 1 : turns };
}

/** @param {number} count */
function evenly(count) {
  return Array.from({ length: count }, (_, i) => i / count);
}

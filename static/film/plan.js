// Plans a film: the size and times of its frames.
import { WIGGLE_S } from './camera-path.js';

/**
 * @typedef {{kind: 'mp4' | 'webm' | 'gif', style: string, seconds: number, side: number}} FilmOptions `side`: the longer side, pixels
 * @typedef {{width: number, height: number, times: number[], frameMs: number, turns: number}} Plan `times`: times of the frames as shares of
 *   the film, each shown for `frameMs`; `turns`: how often the camera path repeats
 */

/** Duration of a frame, ms. GIF counts in hundredths of a second, and browsers slow down frames under 20 ms. */
const VIDEO_MS = 1000 / 30;
const GIF_MS = 60;
/** Approximate duration of a turn, seconds. */
const TURN_S = 4;

/**
 * @param {FilmOptions} options
 * @param {{width: number, height: number}} photo
 * @returns {Plan}
 */
export function planOf({ kind, style, seconds, side }, photo) {
  const scale = Math.min(1, side / Math.max(photo.width, photo.height));
  // video codecs subsample chroma, so they need even sizes
  const step = kind === 'gif' ? 1 : 2;
  const pixels = (/** @type {number} */ v) => Math.max(step, Math.round((v * scale) / step) * step);
  const [width, height] = [pixels(photo.width), pixels(photo.height)];
  if (style === 'wiggle') {
    const frameMs = WIGGLE_S * 1000;
    // a GIF loops
    const turns = kind === 'gif' ? 1 : Math.max(1, Math.round(seconds / (4 * WIGGLE_S)));
    return { width, height, times: evenly(4 * turns), frameMs, turns };
  }
  const frameMs = kind === 'gif' ? GIF_MS : VIDEO_MS;
  const turns = Math.max(1, Math.round(seconds / TURN_S));
  // a GIF loops, so one turn is enough
  const length = kind === 'gif' ? seconds / turns : seconds;
  return { width, height, times: evenly(Math.max(2, Math.round((length * 1000) / frameMs))), frameMs, turns: kind === 'gif' ? 1 : turns };
}

/** @param {number} count */
function evenly(count) {
  return Array.from({ length: count }, (_, i) => i / count);
}

// Waits for conditions instead of fixed times.
import assert from 'node:assert/strict';

/** Timeout of all waits; software rendering on a busy machine is slow. */
export const TIMEOUT_MS = 60_000;
/** Pause between two checks. */
export const POLL_MS = 20;

/**
 * Waits until `condition` returns a truthy value, and returns it.
 * @template T
 * @param {() => T | Promise<T>} condition
 * @param {() => unknown} [details] for the message after a timeout
 * @returns {Promise<T>}
 */
export async function until(condition, details = () => '') {
  for (const end = performance.now() + TIMEOUT_MS; ; await new Promise((resume) => setTimeout(resume, POLL_MS))) {
    const value = await condition();
    if (value) return value;
    if (performance.now() > end) assert.fail(`timed out: ${condition} ${JSON.stringify(details())}`);
  }
}

/**
 * In the page: whether a viewer is still. It skips the rest of the slight enlargement that follows a move of the camera (`away` in
 * static/input/camera-motion.js), which takes seconds longer than the move.
 */
const isStill = (viewer) => {
  const { motion } = viewer;
  const isOff = (axis) => Math.abs(motion.now[axis]) > 0.02 || Math.abs(motion.raw[axis]) > 0.02;
  if (viewer.moving && !motion.idle && !motion.level) motion.away = ['x', 'y', 'z'].some(isOff) ? 1 : 0;
  return !viewer.moving;
};

/**
 * Waits until a viewer is still and `when`, which gets it and `given`, is true; `viewer`: an expression in the page.
 * @param {import('playwright-core').Page} page
 * @param {{viewer?: string, when?: (viewer: any, given: any) => boolean, given?: unknown}} [options]
 */
export function waitForStill(page, { viewer = 'window.viewer', when = () => true, given = null } = {}) {
  // evaluated, because the page's script policy forbids functions of text
  return until(() => page.evaluate(`((v) => (${isStill})(v) && (${when})(v, ${JSON.stringify(given)}))(${viewer})`));
}

/** Waits for `count` animation frames, so that pending changes are drawn. */
export const waitForAnimationFrames = (page, count) =>
  page.evaluate(async (n) => {
    for (let i = 0; i < n; i++) await new Promise(requestAnimationFrame);
  }, count);

/** A promise `opened` that resolves when `open` is called. */
export function gate() {
  const result = {};
  result.opened = new Promise((resolve) => (result.open = resolve));
  return result;
}

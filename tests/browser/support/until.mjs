// Waiting for what a test needs, in place of pauses of a fixed length.
import assert from 'node:assert/strict';

/** Time after which nothing is waited for any longer: software drawing on a busy machine takes its time. */
export const PATIENCE_MS = 60_000;
/** Pause between two looks. */
const LOOK_MS = 10;

/**
 * Waits until `holds` gives something true, and gives that.
 * @template T
 * @param {() => T | Promise<T>} holds
 * @param {() => unknown} [seen] what to say where it never does
 * @returns {Promise<T>}
 */
export async function until(holds, seen = () => '') {
  for (const end = performance.now() + PATIENCE_MS; ; await new Promise((resume) => setTimeout(resume, LOOK_MS))) {
    const found = await holds();
    if (found) return found;
    if (performance.now() > end) assert.fail(`never: ${holds} ${JSON.stringify(seen())}`);
  }
}

/** Lets the page draw so many frames: whatever was on its way to them is there then. */
export const frames = (page, count) =>
  page.evaluate(async (n) => {
    for (let i = 0; i < n; i++) await new Promise(requestAnimationFrame);
  }, count);

/** Something to wait for, `opened`, which holds until `open` is called. */
export function gate() {
  const made = {};
  made.opened = new Promise((resolve) => (made.open = resolve));
  return made;
}

// Shares the WebGL2 contexts of a page among its viewers. Browsers limit the contexts of a page and drop the oldest one beyond that. So
// viewers out of sight give up theirs to visible ones, and visible ones wait if none is left.

/** Fewer than browsers allow (Chromium: 16, on phones 8), because the rest of the page may use some. */
const most = () => (matchMedia('(pointer: coarse)').matches ? 6 : 12);

/**
 * A viewer that has a context or waits for one.
 * @typedef {object} Holder
 * @property {() => boolean} asleep whether the viewer is out of sight
 * @property {() => boolean} busy whether its context is being set up, and cannot be given back before that is done
 * @property {() => void} giveBack releases the context
 * @property {() => void} retry requests a context again
 */

/** Viewers with a context, the longest-held first. @type {Set<Holder>} */
const holders = new Set();
/** @type {Set<Holder>} */
const waiting = new Set();

/**
 * Reserves a context; returns false if none is left, and then calls `retry` once there is one.
 * @param {Holder} holder
 */
export function takeContext(holder) {
  if (!holders.has(holder) && holders.size >= most()) {
    const asleep = [...holders].find((other) => other.asleep() && !other.busy());
    if (asleep) evict(asleep);
  }
  if (!holders.has(holder) && holders.size >= most()) {
    waiting.add(holder);
    return false;
  }
  waiting.delete(holder);
  holders.add(holder);
  return true;
}

/**
 * Gives a waiting viewer that the user interacts with the longest-held context.
 * @param {Holder} holder
 */
export function insistOnContext(holder) {
  if (!waiting.has(holder)) return;
  const oldest = [...holders].find((other) => !other.busy());
  if (!oldest) return;
  evict(oldest);
  waiting.delete(holder);
  holder.retry();
  if (!oldest.asleep()) waiting.add(oldest);
}

/**
 * Removes a viewer that needs no context any more.
 * @param {Holder} holder
 */
export function leaveContext(holder) {
  waiting.delete(holder);
  if (holders.delete(holder)) callNext();
}

/**
 * Offers the context of a viewer that is out of sight to a waiting one. Call it when the viewer goes out of sight or is set up.
 * @param {Holder} holder
 */
export function lendContext(holder) {
  if (!holder.asleep()) return;
  waiting.delete(holder);
  if (!waiting.size || !holders.has(holder) || holder.busy()) return;
  evict(holder);
  callNext();
}

/** @param {Holder} holder */
function evict(holder) {
  holders.delete(holder);
  holder.giveBack();
}

function callNext() {
  for (const holder of [...waiting]) {
    if (holders.size >= most()) return;
    waiting.delete(holder);
    holder.retry();
  }
}

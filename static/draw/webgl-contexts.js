// The WebGL2 contexts of a page's viewers. A browser has so many for a page, and takes the oldest away where more are asked for: viewers out of
// sight give theirs back to those in sight, and these wait where there is none left.

/** Fewer than browsers have: others on the page may have some. Chromium has 16, and 8 on phones. */
const most = () => (matchMedia('(pointer: coarse)').matches ? 6 : 12);

/**
 * Who has a context, or waits for one.
 * @typedef {object} Holder
 * @property {() => boolean} asleep whether nobody sees it
 * @property {() => boolean} busy whether its context is being made ready, and cannot be given back before that is done
 * @property {() => void} giveBack drops the context
 * @property {() => void} retry asks for one again
 */

/** Those with a context, the one that has had it the longest first. @type {Set<Holder>} */
const holders = new Set();
/** @type {Set<Holder>} */
const waiting = new Set();

/**
 * Leave to have a context; false where there is none left, and `retry` is called once there is.
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
 * Somebody uses what waits: it gets the context of whoever has had one the longest.
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
 * It has no context any more, and wants none.
 * @param {Holder} holder
 */
export function leaveContext(holder) {
  waiting.delete(holder);
  if (holders.delete(holder)) callNext();
}

/**
 * Nobody sees it, or it is ready: whoever waits may have its context where it needs none.
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

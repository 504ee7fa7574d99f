// Pictures sent to the page but not shown yet. A slow page gets one at a time, so that the next one it gets is the newest. A fast page
// gets another one while the first waits for a screen refresh, so that none is skipped.

/** Most pictures in flight to a fast page. */
const MAX_PICTURES = 2;
/** A page is fast if it shows a picture within this many frame intervals. */
const FAST_INTERVALS = 2;
/** Weight of the newest sample in smoothed values. */
const WEIGHT = 0.1;

/** @typedef {{frame: number, time: number}} FrameTime number and capture time (µs) of a frame */

export class InFlight {
  /** @type {{of: FrameTime | null, sent: number, whole: boolean}[]} */
  #pictures = [];
  /** Smoothed time from sending to showing, ms; 0 before the first. */
  #showMs = 0;

  /** True if nothing is in flight. */
  get empty() {
    return !this.#pictures.length;
  }

  /**
   * Whether another picture may be sent.
   * @param {number} interval frame interval, ms
   */
  canSend(interval) {
    if (this.empty) return true;
    const fast = this.#showMs > 0 && this.#showMs < FAST_INTERVALS * interval;
    return fast && this.#pictures.length < MAX_PICTURES && !this.#pictures.some(({ whole }) => whole);
  }

  /**
   * Records that a picture was sent.
   * @param {FrameTime | null} of the frame that it shows
   * @param {number} now ms
   * @param {boolean} [whole] whether the page starts over with it: nothing else is sent until it is shown
   */
  sent(of, now, whole = false) {
    this.#pictures.push({ of, sent: now, whole });
  }

  /**
   * Records that the page shows the oldest picture in flight.
   * @param {number} now ms
   * @returns {FrameTime | null} the frame that it shows
   */
  shown(now) {
    const first = this.#pictures.shift();
    if (!first) return null;
    // starting over takes longer than an update
    if (!first.whole) this.#showMs += (now - first.sent - this.#showMs) * (this.#showMs ? WEIGHT : 1);
    return first.of;
  }

  /** Forgets all pictures in flight. */
  clear() {
    this.#pictures = [];
  }

  /**
   * Time since the newest picture in flight was sent, ms.
   * @param {number} now ms
   */
  age(now) {
    const last = this.#pictures.at(-1);
    return last ? now - last.sent : 0;
  }
}

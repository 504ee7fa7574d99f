// Pictures that a page was sent and does not show yet. One at a time where it takes long to show them: what it is sent next is the newest then.
// Where it is quick another one is made meanwhile, so that none is left out for its having to wait for the screen.

/** Pictures that a quick page has at a time. */
const MOST = 2;
/** Times from one frame to the next within which a quick page shows one that it was sent. */
const FRAMES = 2;
/** Weight of the newest in what is smoothed. */
const WEIGHT = 0.1;

/** @typedef {{frame: number, time: number}} Shown number of a frame, and when it was taken, µs */

export class UnderWay {
  /** @type {{of: Shown | null, sent: number, whole: boolean}[]} */
  #pictures = [];
  /** How long the page takes to show one, ms; none was shown yet: 0. */
  #usual = 0;

  /** Nothing is under way. */
  get empty() {
    return !this.#pictures.length;
  }

  /**
   * Whether the page can be sent another one.
   * @param {number} interval ms from one frame to the next
   */
  free(interval) {
    if (this.empty) return true;
    const quick = this.#usual > 0 && this.#usual < FRAMES * interval;
    return quick && this.#pictures.length < MOST && !this.#pictures.some(({ whole }) => whole);
  }

  /**
   * One was sent.
   * @param {Shown | null} of the frame that it shows
   * @param {number} now ms
   * @param {boolean} [whole] with which the page begins anew: nothing is sent before it is shown
   */
  sent(of, now, whole = false) {
    this.#pictures.push({ of, sent: now, whole });
  }

  /**
   * The first of them is shown.
   * @param {number} now ms
   * @returns {Shown | null} the frame that it shows
   */
  shown(now) {
    const first = this.#pictures.shift();
    if (!first) return null;
    // to begin anew takes longer than what comes after
    if (!first.whole) this.#usual += (now - first.sent - this.#usual) * (this.#usual ? WEIGHT : 1);
    return first.of;
  }

  /** The page forgets what it was sent. */
  clear() {
    this.#pictures = [];
  }

  /**
   * For how long the last one has been under way, ms.
   * @param {number} now ms
   */
  age(now) {
    const last = this.#pictures.at(-1);
    return last ? now - last.sent : 0;
  }
}

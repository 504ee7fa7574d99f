// How long a frame is held for its tiles, which come a little after it: as long as they usually take, but never so long that it shows.

/** Longest hold, in times from one frame to the next. */
const FRAMES = 1.5;
/** Weight of the newest in what is smoothed. */
const WEIGHT = 0.1;
/** Frames whose arrival is kept. */
const KEPT = 64;
/** Time from one frame to the next where nothing is known, ms. */
const INTERVAL_MS = 33;
/** What is added to the usual time of tiles, as a share. */
const SPARE = 0.5;
/** Frames from one with tiles to the next, so many times in a row, tell how soon others can follow: rooms rest after a frame of which tiles were sent. */
const GAPS = 8;
/** Frames without tiles after which none are waited for: nothing moves. */
const QUIET = 10;

export class Hold {
  /** @type {Map<number, number>} */
  #arrivals = new Map();
  #interval = INTERVAL_MS;
  #last = 0;
  /** How long after their frame tiles come, ms; none came yet: 0. */
  #usual = 0;
  /** The newest frame whose tiles are there. */
  #newest = -1;
  /** Frames from those before to it, the last ones. @type {number[]} */
  #gaps = [];

  /**
   * A frame came.
   * @param {number} frame
   * @param {number} now ms
   */
  arrived(frame, now) {
    if (this.#last) this.#interval += (Math.min(now - this.#last, 1000) - this.#interval) * WEIGHT;
    this.#last = now;
    this.#arrivals.set(frame, now);
    this.#arrivals.delete(frame - KEPT);
  }

  /**
   * Tiles came.
   * @param {number} frame that they belong to
   * @param {number} now ms
   */
  tiles(frame, now) {
    const came = this.#arrivals.get(frame);
    if (came !== undefined) this.#usual += (now - came - this.#usual) * (this.#newest < 0 ? 1 : WEIGHT);
    if (this.#newest >= 0 && frame > this.#newest) this.#gaps = [...this.#gaps.slice(1 - GAPS), frame - this.#newest];
    this.#newest = Math.max(this.#newest, frame);
  }

  /**
   * Time that a frame is still to be held, ms.
   * @param {{frame: number, arrived: number}} of
   * @param {number} now
   */
  left({ frame, arrived }, now) {
    const since = frame - this.#newest;
    const rests = this.#gaps.length === GAPS && since < Math.min(...this.#gaps);
    if (since <= 0 || rests || (this.#newest >= 0 && since > QUIET)) return 0;
    const most = Math.min(this.#usual * (1 + SPARE), this.#interval * FRAMES);
    return arrived + most - now;
  }
}

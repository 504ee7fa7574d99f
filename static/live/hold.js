// How long a frame is held for its tiles, which come a little after it: as long as they usually take, where that is little. Else it is shown with what is there,
// whose labels follow what moves, and the tiles are shown with the next one.

/**
 * Longest hold, in times from one frame to the next. Longer ones gain little: tiles that are a frame late have a thing's edge .02 pixels farther off with estimated
 * depth, .08 with measured, which comes soon (`tmpi-lab live-bench --only still,measured --late 1`); and they cost 20 ms from the camera to the screen at the median.
 */
const FRAMES = 0.5;
/** Weight of the newest in what is smoothed. */
const WEIGHT = 0.1;
/** Frames whose arrival is kept. */
const KEPT = 64;
/** Time from one frame to the next where nothing is known, ms. */
const INTERVAL_MS = 33;
/** What is added to the usual time of tiles, as a share. */
const SPARE = 0.5;
/** Tiles that came after their frame was shown wait for the next one as long as this from the last one, in times from one frame to the next; but not where that is long, ms. */
const NEXT = 1.5;
const LONG_MS = 50;
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

  /** Time from one frame to the next, ms. */
  get interval() {
    return this.#interval;
  }

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
    const most = this.#usual * (1 + SPARE);
    return most > this.#interval * FRAMES ? 0 : arrived + most - now;
  }

  /**
   * Time that tiles which came after their frame was shown are to wait for the next one, to be shown with it, ms: to draw a picture twice takes time that
   * the next one lacks.
   * @param {number} now
   */
  next(now) {
    return this.#interval > LONG_MS ? 0 : this.#last + this.#interval * NEXT - now;
  }
}

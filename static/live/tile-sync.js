// Synchronises frames with their tiles, which arrive a little later. A frame waits as long as its tiles typically take, if that is short.
// Otherwise it is shown with the existing tiles, whose labels follow the motion, and the new tiles are shown with the next frame.

/**
 * Longest wait, in frame intervals. Waiting longer gains little: with tiles that are one frame late, edges of objects are off by another
 * .02 pixels with estimated depth, .08 with measured depth, which arrives soon (`tmpi-lab live-bench --only still,measured --late 1`).
 * Waiting would add 20 ms to the median latency from camera to screen.
 */
const MAX_WAIT_INTERVALS = 0.5;
/** Weight of the newest sample in smoothed values. */
const WEIGHT = 0.1;
/** Count of frames whose arrival time is kept. */
const ARRIVALS_KEPT = 64;
/** Frame interval before any frame was measured, ms. */
const INTERVAL_MS = 33;
/** Margin added to the typical delay of tiles, as a share of it. */
const MARGIN = 0.5;
/** Tiles that missed their frame wait for the next one, up to LATE_INTERVALS frame intervals after the last, if the interval is not over LONG_MS. */
const LATE_INTERVALS = 1.5;
const LONG_MS = 50;
/** Count of gaps between frames with tiles that tell how soon tiles can follow: rooms skip geometry for a while after sending tiles. */
const GAP_COUNT = 8;
/** Frames without tiles after which frames stop waiting: nothing moves. */
const IDLE_FRAMES = 10;

export class TileSync {
  /** @type {Map<number, number>} */
  #arrivals = new Map();
  #interval = INTERVAL_MS;
  #last = 0;
  /** Smoothed delay of tiles after their frame, ms; 0 before the first. */
  #tileDelay = 0;
  /** The newest frame whose tiles have arrived. */
  #newest = -1;
  /** The latest gaps between frames with tiles, in frames. @type {number[]} */
  #gaps = [];

  /** Smoothed frame interval, ms. */
  get interval() {
    return this.#interval;
  }

  /**
   * Records the arrival of a frame.
   * @param {number} frame
   * @param {number} now ms
   */
  frameArrived(frame, now) {
    if (this.#last) this.#interval += (Math.min(now - this.#last, 1000) - this.#interval) * WEIGHT;
    this.#last = now;
    this.#arrivals.set(frame, now);
    this.#arrivals.delete(frame - ARRIVALS_KEPT);
  }

  /**
   * Records the arrival of tiles.
   * @param {number} frame that they belong to
   * @param {number} now ms
   */
  tilesArrived(frame, now) {
    const came = this.#arrivals.get(frame);
    if (came !== undefined) this.#tileDelay += (now - came - this.#tileDelay) * (this.#newest < 0 ? 1 : WEIGHT);
    if (this.#newest >= 0 && frame > this.#newest) this.#gaps = [...this.#gaps.slice(1 - GAP_COUNT), frame - this.#newest];
    this.#newest = Math.max(this.#newest, frame);
  }

  /**
   * How much longer a frame must wait for its tiles, ms.
   * @param {{frame: number, arrived: number}} of
   * @param {number} now
   */
  waitFor({ frame, arrived }, now) {
    const since = frame - this.#newest;
    const paused = this.#gaps.length === GAP_COUNT && since < Math.min(...this.#gaps);
    if (since <= 0 || paused || (this.#newest >= 0 && since > IDLE_FRAMES)) return 0;
    const most = this.#tileDelay * (1 + MARGIN);
    return most > this.#interval * MAX_WAIT_INTERVALS ? 0 : arrived + most - now;
  }

  /**
   * How long tiles that missed their frame must wait to be shown with the next one, ms: drawing a picture twice takes time that the next
   * one needs.
   * @param {number} now
   */
  lateTilesWait(now) {
    return this.#interval > LONG_MS ? 0 : this.#last + this.#interval * LATE_INTERVALS - now;
  }
}

// How long frames take, and how many pixels can be drawn while something moves or a room plays.

/** Weight of the newest frame in the time told. */
const WEIGHT = 0.15;
/** A frame slower than this, while moving, is drawn with fewer pixels the next time; at rest the picture is always whole. */
export const SLOW_MS = 40;
const COARSER = 0.8;
const COARSEST = 0.5;
/** The same of a room, whose frames may have far fewer pixels than the screen. */
const COARSEST_ROOM = 0.2;

export class FramePacing {
  #coarsest;

  /** @param {boolean} [room] */
  constructor(room = false) {
    this.#coarsest = room ? COARSEST_ROOM : COARSEST;
  }

  /**
   * Smoothed time of a frame in ms, or null before the first.
   * @type {number | null}
   */
  ms = null;
  /** Share of the pixels a side that is drawn while something moves. */
  detail = 1;
  #measuring = false;

  /**
   * Measures from submission to completion, one frame at a time.
   * @param {{idle: () => Promise<void>}} renderer that a frame was just handed to
   * @param {() => boolean} moving
   * @returns {Promise<number | null>} the frame's time in ms, or null where it was not measured
   */
  async measure(renderer, moving) {
    if (this.#measuring) return null;
    this.#measuring = true;
    const started = performance.now();
    try {
      await renderer.idle();
    } catch {
      // the device is gone, which is dealt with where it is noticed
      return null;
    } finally {
      this.#measuring = false;
    }
    const ms = performance.now() - started;
    this.ms = this.ms === null ? ms : this.ms + (ms - this.ms) * WEIGHT;
    if (moving() && ms > SLOW_MS) this.detail = Math.max(this.#coarsest, this.detail * COARSER);
    else if (ms < SLOW_MS / 2) this.detail = Math.min(1, this.detail / COARSER);
    return ms;
  }
}

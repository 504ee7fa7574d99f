// Measures frame times, and adapts the resolution while the camera moves or a room plays.

/** Weight of the newest frame in the smoothed time. */
const WEIGHT = 0.15;
/** If a frame takes longer than this while moving, the next one has fewer pixels; at rest, the resolution is always full. */
export const SLOW_MS = 40;
const STEP = 0.8;
const MIN_DETAIL = 0.5;
/** The same for a room, whose frames may have far fewer pixels than the screen. */
const MIN_DETAIL_ROOM = 0.2;

export class AdaptiveResolution {
  #minDetail;

  /** @param {boolean} [room] */
  constructor(room = false) {
    this.#minDetail = room ? MIN_DETAIL_ROOM : MIN_DETAIL;
  }

  /**
   * Smoothed time of a frame in ms, or null before the first.
   * @type {number | null}
   */
  ms = null;
  /** Resolution per side while something moves, as a share of the full one. */
  detail = 1;
  #measuring = false;

  /**
   * Measures from submission to completion, one frame at a time.
   * @param {{idle: () => Promise<void>}} renderer that a frame was just submitted to
   * @param {() => boolean} moving
   * @returns {Promise<number | null>} the frame's time in ms, or null if it was not measured
   */
  async measure(renderer, moving) {
    if (this.#measuring) return null;
    this.#measuring = true;
    const started = performance.now();
    try {
      await renderer.idle();
    } catch {
      // the device is lost, which its `lost` handler deals with
      return null;
    } finally {
      this.#measuring = false;
    }
    const ms = performance.now() - started;
    this.ms = this.ms === null ? ms : this.ms + (ms - this.ms) * WEIGHT;
    if (moving() && ms > SLOW_MS) this.detail = Math.max(this.#minDetail, this.detail * STEP);
    else if (ms < SLOW_MS / 2) this.detail = Math.min(1, this.detail / STEP);
    return ms;
  }
}

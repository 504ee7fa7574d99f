// What a page that watches measures of itself.

/** Weight of the newest in what is smoothed. */
const WEIGHT = 0.1;

/** Smoothed times in ms, and counts since they were told last. */
export class Measurements {
  #ms = { made: 0, copy: 0, video: 0 };
  #latency = 0;
  #lag = 0;
  /** Fastest way of a frame so far, ms between two clocks. */
  #fastest = Infinity;
  frames = 0;
  bytes = 0;

  /** Another publisher, with another clock. */
  begin() {
    this.#fastest = Infinity;
  }

  /**
   * @param {'made' | 'copy' | 'video'} what layers were composed, samples were copied, a frame was decoded
   * @param {number} ms
   */
  took(what, ms) {
    const before = this.#ms[what];
    this.#ms[what] = before ? before + (ms - before) * WEIGHT : ms;
  }

  /**
   * A frame came.
   * @param {number} time of the publisher, µs
   * @param {number} arrived ms of `performance.now()`
   */
  arrived(time, arrived) {
    const way = performance.timeOrigin + arrived - time / 1000;
    this.#fastest = Math.min(this.#fastest, way);
    this.#lag += (way - this.#fastest - this.#lag) * WEIGHT;
  }

  /**
   * A frame is on the screen.
   * @param {number} time of the publisher, µs
   */
  shown(time) {
    this.#latency = performance.timeOrigin + performance.now() - time / 1000;
  }

  /**
   * What is told of the last `ms`; counts begin anew.
   * @param {number} ms
   */
  since(ms) {
    const { made: madeMs, copy: copyMs, video: videoMs } = this.#ms;
    const rates = { frames: (this.frames * 1000) / ms, kbits: (this.bytes * 8) / ms };
    this.frames = this.bytes = 0;
    return { madeMs, copyMs, videoMs, latency: this.#latency, lag: this.#lag, ...rates };
  }
}

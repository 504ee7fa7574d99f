// Playback statistics of a page that watches a room.

/** Weight of the newest sample in smoothed values. */
const WEIGHT = 0.1;

/** Smoothed times in ms, and counts since the last report. */
export class Measurements {
  #ms = { made: 0, copy: 0, video: 0 };
  #latency = 0;
  #lag = 0;
  /** Shortest transit time of a frame so far, ms; it includes the offset between the two clocks. */
  #fastest = Infinity;
  frames = 0;
  bytes = 0;

  /** Resets what depends on the publisher's clock. */
  begin() {
    this.#fastest = Infinity;
  }

  /**
   * @param {'made' | 'copy' | 'video'} what composing layers, copying samples, or decoding a frame
   * @param {number} ms
   */
  took(what, ms) {
    const before = this.#ms[what];
    this.#ms[what] = before ? before + (ms - before) * WEIGHT : ms;
  }

  /**
   * Records the arrival of a frame.
   * @param {number} time capture time by the publisher's clock, µs
   * @param {number} arrived `performance.now()`, ms
   */
  arrived(time, arrived) {
    const transit = performance.timeOrigin + arrived - time / 1000;
    this.#fastest = Math.min(this.#fastest, transit);
    this.#lag += (transit - this.#fastest - this.#lag) * WEIGHT;
  }

  /**
   * Records that a frame is on the screen.
   * @param {number} time capture time by the publisher's clock, µs
   */
  shown(time) {
    this.#latency = performance.timeOrigin + performance.now() - time / 1000;
  }

  /**
   * Reports the last `ms` milliseconds and resets the counts.
   * @param {number} ms
   */
  since(ms) {
    const { made: madeMs, copy: copyMs, video: videoMs } = this.#ms;
    const rates = { frames: (this.frames * 1000) / ms, kbits: (this.bytes * 8) / ms };
    this.frames = this.bytes = 0;
    return { madeMs, copyMs, videoMs, latency: this.#latency, lag: this.#lag, ...rates };
  }
}

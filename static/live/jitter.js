// Estimates the playout delay that hides jitter: as long as most frames are late, and zero on a steady connection.
// Pure: callers pass the times.

/** Longest playout delay, ms; a frame that is later than that is an outage, not jitter. */
const MAX_DELAY_MS = 200;
/** Jitter that is not corrected, ms: one screen refresh. */
const IGNORED_MS = 17;
/** Share of frames that must arrive in time. */
const SHARE = 0.95;
/** Largest and smallest number of frames that the estimate is based on. */
const MAX_FRAMES = 120;
const MIN_FRAMES = 15;
/** Largest decrease of the delay per frame, ms: the picture then runs slightly faster, which nobody notices. */
const STEP_MS = 1;
/** The shortest transit time is taken over the last SPANS spans of SPAN_MS, because clocks drift apart. */
const SPANS = 5;
const SPAN_MS = 2000;
/** A clock has jumped if the transit time is shorter by JUMP_MS, or longer by it for STRAYS frames in a row. */
const JUMP_MS = 500;
const STRAYS = 45;

export class Jitter {
  /** Shortest transit time of each span, and when the span began. @type {{from: number, transit: number}[]} */
  #fastest = [];
  /** Transit times minus the shortest one, ms, oldest first. @type {number[]} */
  #lateness = [];
  #strays = 0;
  /** The quantile SHARE of the lateness of frames, ms. */
  jitter = 0;
  /** Playout delay on top of the shortest transit time, ms. */
  delay = 0;

  /**
   * Records the arrival of a frame; returns when it is due, ms by the clock of `now`, in the past if it is late.
   * @param {number} time capture time, ms by the publisher's clock
   * @param {number} now ms
   */
  arrived(time, now) {
    const transit = now - time;
    const before = this.#shortest();
    this.#strays = transit > before + JUMP_MS ? this.#strays + 1 : 0;
    if (transit < before - JUMP_MS || this.#strays >= STRAYS) this.#reset();
    this.#remember(transit, now);
    const shortest = this.#shortest();
    if (transit - shortest <= MAX_DELAY_MS) this.#count(transit - shortest);
    return time + shortest + this.delay;
  }

  #reset() {
    [this.#fastest, this.#lateness, this.#strays, this.jitter] = [[], [], 0, 0];
  }

  #shortest() {
    return Math.min(...this.#fastest.map(({ transit }) => transit));
  }

  /**
   * @param {number} transit
   * @param {number} now
   */
  #remember(transit, now) {
    const last = this.#fastest.at(-1);
    if (last && now - last.from < SPAN_MS) last.transit = Math.min(last.transit, transit);
    else this.#fastest = [...this.#fastest.slice(1 - SPANS), { from: now, transit }];
  }

  /** @param {number} late */
  #count(late) {
    this.#lateness = [...this.#lateness.slice(1 - MAX_FRAMES), late];
    const sorted = this.#lateness.toSorted((a, b) => a - b);
    this.jitter = sorted[Math.ceil(SHARE * sorted.length) - 1];
    const wanted = sorted.length < MIN_FRAMES ? 0 : Math.max(0, this.jitter - IGNORED_MS);
    this.delay = Math.max(wanted, this.delay - STEP_MS);
  }
}

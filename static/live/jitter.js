// How long frames are held so that they are shown as evenly as they were taken: as unevenly as most of them come, and not at all on a calm line.
// Pure: times are handed in.

/** Longest time that a frame is held for, ms; what comes later than that is no jitter but an outage. */
const MOST_MS = 200;
/** Jitter that is left as it is, ms: one refresh of a screen. */
const FREE_MS = 17;
/** Share of the frames that are to be there in time. */
const SHARE = 0.95;
/** Frames whose jitter is kept, and how many there must be. */
const KEPT = 120;
const LEAST = 15;
/** By how much the delay falls with each frame, ms: the picture then runs a little faster, which is not seen. */
const STEP_MS = 1;
/** The fastest way is of the last so many spans, ms each: clocks drift apart. */
const SPANS = 5;
const SPAN_MS = 2000;
/** Two clocks are others, ms, where the way is so much shorter, or so much longer for so many frames. */
const JUMP_MS = 500;
const STRAYS = 45;

export class Jitter {
  /** Shortest ways, by when the span began. @type {{from: number, way: number}[]} */
  #fastest = [];
  /** By how much ways were longer than the fastest, ms, oldest first. @type {number[]} */
  #spreads = [];
  #strays = 0;
  /** How unevenly frames come, ms: the share of them that is to be there in time is no later than that. */
  jitter = 0;
  /** How long after the fastest way a frame is due, ms. */
  delay = 0;

  /**
   * A frame came: when it is to be shown, ms by the clock of `now`; in the past where it is late.
   * @param {number} time when it was taken, ms by the publisher's clock
   * @param {number} now ms
   */
  arrived(time, now) {
    const way = now - time;
    const before = this.#least();
    this.#strays = way > before + JUMP_MS ? this.#strays + 1 : 0;
    if (way < before - JUMP_MS || this.#strays >= STRAYS) this.#begin();
    this.#remember(way, now);
    const least = this.#least();
    if (way - least <= MOST_MS) this.#count(way - least);
    return time + least + this.delay;
  }

  #begin() {
    [this.#fastest, this.#spreads, this.#strays, this.jitter] = [[], [], 0, 0];
  }

  #least() {
    return Math.min(...this.#fastest.map(({ way }) => way));
  }

  /**
   * @param {number} way
   * @param {number} now
   */
  #remember(way, now) {
    const last = this.#fastest.at(-1);
    if (last && now - last.from < SPAN_MS) last.way = Math.min(last.way, way);
    else this.#fastest = [...this.#fastest.slice(1 - SPANS), { from: now, way }];
  }

  /** @param {number} spread */
  #count(spread) {
    this.#spreads = [...this.#spreads.slice(1 - KEPT), spread];
    const sorted = this.#spreads.toSorted((a, b) => a - b);
    this.jitter = sorted[Math.ceil(SHARE * sorted.length) - 1];
    const wanted = sorted.length < LEAST ? 0 : Math.max(0, this.jitter - FREE_MS);
    this.delay = Math.max(wanted, this.delay - STEP_MS);
  }
}

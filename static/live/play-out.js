// Keeps what came of a room until it is due, in the order in which it came.

/** Messages that wait, at most: a frame that is held has few of tiles behind it. */
const MOST = 256;

/** @template T */
export class PlayOut {
  /** @type {{item: T, due: number, needed: boolean}[]} */
  #waiting = [];
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #timer;
  #release;

  /** @param {(item: T) => void} release */
  constructor(release) {
    this.#release = release;
  }

  /** Nothing waits. */
  get empty() {
    return !this.#waiting.length;
  }

  /**
   * Releases something when it is due and all before it was released; now, where both is so.
   * @param {T} item
   * @param {number} [due] by `performance.now()`; right after what came before it where none is given
   * @param {boolean} [needed] whether it counts though nobody looks
   */
  push(item, due = 0, needed = false) {
    if (this.empty && due <= performance.now()) return this.#release(item);
    this.#waiting.push({ item, due, needed });
    this.#run();
  }

  /** Forgets what waits. */
  clear() {
    clearTimeout(this.#timer);
    this.#waiting = [];
  }

  /** Releases at once what is needed of what waits, and forgets the rest. */
  hurry() {
    const waiting = this.#waiting;
    this.clear();
    for (const { item } of waiting.filter(({ needed }) => needed)) this.#release(item);
  }

  #run() {
    clearTimeout(this.#timer);
    while (this.#waiting.length && (this.#waiting[0].due <= performance.now() || this.#waiting.length > MOST)) {
      const [{ item }] = this.#waiting.splice(0, 1);
      this.#release(item);
    }
    if (this.#waiting.length) this.#timer = setTimeout(() => this.#run(), this.#waiting[0].due - performance.now());
  }
}

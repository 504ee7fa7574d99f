// Playout buffer: keeps messages of a room until they are due, in the order of arrival.

/** Most messages kept: only a few tile updates queue behind a delayed frame. */
const MAX_ITEMS = 256;

/** @template T */
export class PlayoutBuffer {
  /** @type {{item: T, due: number, needed: boolean}[]} */
  #waiting = [];
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #timer;
  #release;

  /** @param {(item: T) => void} release */
  constructor(release) {
    this.#release = release;
  }

  /** True if nothing is buffered. */
  get empty() {
    return !this.#waiting.length;
  }

  /**
   * Releases `item` once it is due and everything before it has been released; at once if both hold already.
   * @param {T} item
   * @param {number} [due] by `performance.now()`; by default directly after the previous item
   * @param {boolean} [needed] whether `flush` releases it instead of dropping it
   */
  push(item, due = 0, needed = false) {
    if (this.empty && due <= performance.now()) return this.#release(item);
    this.#waiting.push({ item, due, needed });
    this.#run();
  }

  /** Drops all items. */
  clear() {
    clearTimeout(this.#timer);
    this.#waiting = [];
  }

  /** Releases the needed items at once and drops the others. */
  flush() {
    const waiting = this.#waiting;
    this.clear();
    for (const { item } of waiting.filter(({ needed }) => needed)) this.#release(item);
  }

  #run() {
    clearTimeout(this.#timer);
    while (this.#waiting.length && (this.#waiting[0].due <= performance.now() || this.#waiting.length > MAX_ITEMS)) {
      const [{ item }] = this.#waiting.splice(0, 1);
      this.#release(item);
    }
    if (this.#waiting.length) this.#timer = setTimeout(() => this.#run(), this.#waiting[0].due - performance.now());
  }
}

// How close one looks: which part of the photo is shown, how large, and how it eases there. The lens changes, not the camera's place,
// so near and far things keep their sizes to each other.

/** @import { Frame } from '../view/camera.js' */

/** Time constant of the easing, seconds. */
const EASE_S = 0.08;
const REST = 1e-3;
/** From here on one has zoomed in. */
const CLOSE = 1.01;
/** One can come so much closer whatever the photo. */
const LEAST = 3;

export class Zoom {
  /** Where it goes: scale, 1 where all of the photo is seen, and the photo's place in the middle, in shares of its width and height. */
  target = { scale: 1, x: 0.5, y: 0.5 };
  now = { scale: 1, x: 0.5, y: 0.5 };
  /** Scale at which a pixel of the photo is one of the screen. */
  own = 1;
  /** Width and height of the element and of the whole photo at scale 1, CSS pixels. */
  #room = { width: 1, height: 1 };
  #fit = { width: 1, height: 1 };

  /** The largest scale: twice the photo's own pixels. */
  get most() {
    return Math.max(LEAST, 2 * this.own);
  }

  /** True while less than the whole photo is shown, or will be. */
  get close() {
    return this.target.scale > CLOSE || this.now.scale > CLOSE;
  }

  /**
   * Takes over sizes: of the element, of the photo shown whole in it (both CSS pixels), and the photo's width in pixels of the screen
   * over that.
   * @param {{width: number, height: number}} room
   * @param {{width: number, height: number}} fit
   * @param {number} own
   */
  measure(room, fit, own) {
    [this.#room, this.#fit, this.own] = [room, fit, own];
    this.target = this.#inside(this.target);
    this.now = this.#inside(this.now);
  }

  /** Size of the picture, CSS pixels: the photo's, as far as there is room for it. */
  get size() {
    return this.#sizeAt(this.now.scale);
  }

  /**
   * What of the photo the picture shows.
   * @returns {Frame}
   */
  get frame() {
    const { scale, x, y } = this.now;
    return { scale: (scale * this.#fit.width) / this.size.width, x, y };
  }

  /**
   * Comes closer by a factor, or goes away, while a place stays where it is.
   * @param {number} by
   * @param {{x: number, y: number}} at from the middle of the element, CSS pixels
   */
  by(by, at) {
    const { scale, x, y } = this.target;
    const next = Math.min(this.most, Math.max(1, scale * by));
    const shift = 1 / scale - 1 / next;
    this.target = this.#inside({ scale: next, x: x + (at.x * shift) / this.#fit.width, y: y + (at.y * shift) / this.#fit.height });
  }

  /**
   * To the photo's own pixels, or at least twice as close; from anywhere closer than all of it, back.
   * @param {{x: number, y: number}} at from the middle of the element, CSS pixels
   */
  toggle(at) {
    if (this.target.scale > CLOSE) this.home();
    else this.by(Math.max(2, this.own), at);
  }

  /**
   * Moves the photo by so many CSS pixels, at once.
   * @param {number} dx
   * @param {number} dy
   */
  pan(dx, dy) {
    for (const at of [this.target, this.now]) {
      at.x -= dx / this.#fit.width / at.scale;
      at.y -= dy / this.#fit.height / at.scale;
    }
    this.target = this.#inside(this.target);
    this.now = this.#inside(this.now);
  }

  /** Puts it there at once. */
  settle() {
    this.now = { ...this.target };
  }

  /** Back to all of the photo. */
  home() {
    this.target = { scale: 1, x: 0.5, y: 0.5 };
  }

  /**
   * Advances by `dt` seconds; true while anything moves.
   * @param {number} dt
   */
  step(dt) {
    const { now, target } = this;
    const left = Math.exp(-Math.min(dt, 0.1) / EASE_S);
    // by the reciprocal, so that what lies under the pointer stays there all the way
    const was = 1 / now.scale;
    const is = 1 / target.scale + (was - 1 / target.scale) * left;
    const gone = Math.abs(was - 1 / target.scale) > 1e-9 ? (was - is) / (was - 1 / target.scale) : 1 - left;
    this.now = { scale: 1 / is, x: now.x + (target.x - now.x) * gone, y: now.y + (target.y - now.y) * gone };
    const off =
      Math.abs(this.now.scale / target.scale - 1) + (Math.abs(this.now.x - target.x) + Math.abs(this.now.y - target.y)) * target.scale;
    if (off > REST) return true;
    this.settle();
    return false;
  }

  /** @param {number} scale */
  #sizeAt(scale) {
    const { width, height } = this.#fit;
    return {
      width: Math.min(width * scale, Math.max(width, this.#room.width)),
      height: Math.min(height * scale, Math.max(height, this.#room.height)),
    };
  }

  /** @param {{scale: number, x: number, y: number}} at */
  #inside({ scale, x, y }) {
    const size = this.#sizeAt(scale);
    const within = (/** @type {number} */ v, /** @type {number} */ shown, /** @type {number} */ all) => {
      const half = Math.min(0.5, shown / (2 * all * scale));
      return Math.min(1 - half, Math.max(half, v));
    };
    return { scale, x: within(x, size.width, this.#fit.width), y: within(y, size.height, this.#fit.height) };
  }
}

// Zoom: which part of the photo is shown, at which scale, with easing. It changes the lens and not the camera's position, so near and far
// things keep their relative sizes.

/** @import { Frame } from '../view/camera.js' */

/** Time constant of the easing, seconds. */
const EASE_S = 0.08;
const AT_REST = 1e-3;
/** Scale from which the photo counts as zoomed in. */
const CLOSE = 1.01;
/** Lower bound of the largest scale, whatever the photo's size. */
const MIN_LARGEST = 3;

export class Zoom {
  /** Target of the easing: the scale (1 shows the whole photo) and the centre of the view, in shares of the photo's width and height. */
  target = { scale: 1, x: 0.5, y: 0.5 };
  now = { scale: 1, x: 0.5, y: 0.5 };
  /** Scale at which photo pixels and device pixels have the same size. */
  own = 1;
  /** Sizes of the element and of the whole photo at scale 1, CSS pixels. */
  #element = { width: 1, height: 1 };
  #fit = { width: 1, height: 1 };

  /** The largest scale: two device pixels per photo pixel. */
  get most() {
    return Math.max(MIN_LARGEST, 2 * this.own);
  }

  /** True while the photo is zoomed in, or about to be. */
  get close() {
    return this.target.scale > CLOSE || this.now.scale > CLOSE;
  }

  /**
   * Sets the sizes of the element and of the whole photo in it (both CSS pixels), and the scale at which photo pixels and device pixels
   * have the same size.
   * @param {{width: number, height: number}} element
   * @param {{width: number, height: number}} fit
   * @param {number} own
   */
  measure(element, fit, own) {
    [this.#element, this.#fit, this.own] = [element, fit, own];
    this.target = this.#clamped(this.target);
    this.now = this.#clamped(this.now);
  }

  /** Size of the picture, CSS pixels: that of the scaled photo, limited to the element. */
  get size() {
    return this.#sizeAt(this.now.scale);
  }

  /**
   * The part of the photo that the picture shows.
   * @returns {Frame}
   */
  get frame() {
    const { scale, x, y } = this.now;
    return { scale: (scale * this.#fit.width) / this.size.width, x, y };
  }

  /**
   * Zooms by a factor about a fixed point.
   * @param {number} by
   * @param {{x: number, y: number}} at from the centre of the element, CSS pixels
   */
  by(by, at) {
    const { scale, x, y } = this.target;
    const next = Math.min(this.most, Math.max(1, scale * by));
    const shift = 1 / scale - 1 / next;
    this.target = this.#clamped({ scale: next, x: x + (at.x * shift) / this.#fit.width, y: y + (at.y * shift) / this.#fit.height });
  }

  /**
   * Zooms to the photo's pixels, or to a scale of 2 if that is larger; zooms out if the photo is zoomed in.
   * @param {{x: number, y: number}} at from the centre of the element, CSS pixels
   */
  toggle(at) {
    if (this.target.scale > CLOSE) this.home();
    else this.by(Math.max(2, this.own), at);
  }

  /**
   * Moves the photo by CSS pixels, without easing.
   * @param {number} dx
   * @param {number} dy
   */
  pan(dx, dy) {
    for (const at of [this.target, this.now]) {
      at.x -= dx / this.#fit.width / at.scale;
      at.y -= dy / this.#fit.height / at.scale;
    }
    this.target = this.#clamped(this.target);
    this.now = this.#clamped(this.now);
  }

  /** Jumps to the target. */
  settle() {
    this.now = { ...this.target };
  }

  /** Zooms out to the whole photo. */
  home() {
    this.target = { scale: 1, x: 0.5, y: 0.5 };
  }

  /**
   * Advances by `dt` seconds; returns true while anything moves.
   * @param {number} dt
   */
  step(dt) {
    const { now, target } = this;
    const left = Math.exp(-Math.min(dt, 0.1) / EASE_S);
    // easing the reciprocal of the scale keeps the point under the pointer fixed
    const was = 1 / now.scale;
    const is = 1 / target.scale + (was - 1 / target.scale) * left;
    const share = Math.abs(was - 1 / target.scale) > 1e-9 ? (was - is) / (was - 1 / target.scale) : 1 - left;
    this.now = { scale: 1 / is, x: now.x + (target.x - now.x) * share, y: now.y + (target.y - now.y) * share };
    const distance =
      Math.abs(this.now.scale / target.scale - 1) + (Math.abs(this.now.x - target.x) + Math.abs(this.now.y - target.y)) * target.scale;
    if (distance > AT_REST) return true;
    this.settle();
    return false;
  }

  /** @param {number} scale */
  #sizeAt(scale) {
    const { width, height } = this.#fit;
    return {
      width: Math.min(width * scale, Math.max(width, this.#element.width)),
      height: Math.min(height * scale, Math.max(height, this.#element.height)),
    };
  }

  /** @param {{scale: number, x: number, y: number}} at */
  #clamped({ scale, x, y }) {
    const size = this.#sizeAt(scale);
    const clamp = (/** @type {number} */ v, /** @type {number} */ shown, /** @type {number} */ all) => {
      const half = Math.min(0.5, shown / (2 * all * scale));
      return Math.min(1 - half, Math.max(half, v));
    };
    return { scale, x: clamp(x, size.width, this.#fit.width), y: clamp(y, size.height, this.#fit.height) };
  }
}

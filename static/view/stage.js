// What lies in the viewer's element: the photo, and over it the canvas that the scene is drawn on.
import { fitted } from './canvas-size.js';

/** @import { Frame } from './camera.js' */

export class Stage {
  #root;
  /** @type {HTMLCanvasElement | null} */
  #canvas = null;
  /** @type {HTMLCanvasElement | null} */
  #detail = null;
  #address = '';

  /** @param {HTMLElement} root that the pictures are put into */
  constructor(root) {
    this.#root = root;
    this.poster = document.createElement('img');
    this.poster.alt = '';
    this.#adopt(this.poster, 'tmpi-poster');
  }

  /** What the scene is drawn on, or null. */
  get canvas() {
    return this.#canvas;
  }

  set canvas(canvas) {
    this.#canvas?.remove();
    this.#canvas = canvas;
    if (!canvas) return;
    canvas.setAttribute('aria-hidden', 'true');
    this.#adopt(canvas, 'tmpi-canvas');
  }

  /** What finer parts of the scene are drawn on, over it, or null. */
  get detail() {
    return this.#detail;
  }

  set detail(canvas) {
    if (this.#detail !== canvas) this.#detail?.remove();
    this.#detail = canvas;
    if (!canvas || canvas.parentElement) return;
    canvas.setAttribute('aria-hidden', 'true');
    // the next layout has it too
    if (this.#canvas) [canvas.style.width, canvas.style.height] = [this.#canvas.style.width, this.#canvas.style.height];
    this.#adopt(canvas, 'tmpi-canvas');
  }

  /** @param {Blob} file of the photo */
  showPhoto(file) {
    this.#address = URL.createObjectURL(file);
    this.poster.src = this.#address;
  }

  /** Size of the root, CSS pixels. */
  get room() {
    return { width: this.#root.clientWidth, height: this.#root.clientHeight };
  }

  /**
   * CSS pixels of a picture of that aspect that is shown whole, or null where the root has no area.
   * @param {number} aspect
   */
  fit(aspect) {
    return fitted(this.#root, aspect);
  }

  /**
   * Lays the pictures out: what is drawn in its size, the photo as large as the frame asks for; all CSS pixels.
   * @param {{width: number, height: number}} size of the pictures
   * @param {{width: number, height: number}} fit of the whole photo
   * @param {Frame} frame of the photo in the pictures
   * @param {boolean} drawn whether the photo's element shows views that are drawn already
   */
  lay(size, fit, frame, drawn) {
    for (const element of [this.poster, this.#canvas, this.#detail]) {
      if (!element) continue;
      const own = element === this.poster && !drawn ? fit : size;
      element.style.width = `${own.width}px`;
      element.style.height = `${own.height}px`;
    }
    const scale = (frame.scale * size.width) / fit.width;
    const still = drawn || scale === 1;
    this.poster.style.transform = still ? '' : `scale(${scale}) translate(${(0.5 - frame.x) * 100}%, ${(0.5 - frame.y) * 100}%)`;
  }

  dispose() {
    this.poster.remove();
    this.canvas = this.detail = null;
    if (this.#address) URL.revokeObjectURL(this.#address);
  }

  /**
   * @param {HTMLElement} element
   * @param {string} className
   */
  #adopt(element, className) {
    element.className = className;
    element.draggable = false;
    this.#root.append(element);
  }
}

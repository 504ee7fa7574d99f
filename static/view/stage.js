// The DOM inside the viewer's element: the photo, and the scene's canvas over it.
import { fitted } from './canvas-size.js';

/** @import { Frame } from './camera.js' */

export class Stage {
  #root;
  /** @type {HTMLCanvasElement | null} */
  #canvas = null;
  /** @type {HTMLCanvasElement | null} */
  #detail = null;
  #address = '';

  /** @param {HTMLElement} root parent of the pictures */
  constructor(root) {
    this.#root = root;
    this.poster = document.createElement('img');
    this.poster.alt = '';
    this.#append(this.poster, 'tmpi-poster');
  }

  /** The scene's canvas, or null. */
  get canvas() {
    return this.#canvas;
  }

  set canvas(canvas) {
    this.#canvas?.remove();
    this.#canvas = canvas;
    if (!canvas) return;
    canvas.setAttribute('aria-hidden', 'true');
    this.#append(canvas, 'tmpi-canvas');
  }

  /** The canvas for finer parts, over the scene's canvas, or null. */
  get detail() {
    return this.#detail;
  }

  set detail(canvas) {
    if (this.#detail !== canvas) this.#detail?.remove();
    this.#detail = canvas;
    if (!canvas || canvas.parentElement) return;
    canvas.setAttribute('aria-hidden', 'true');
    // until the next layout sets the size
    if (this.#canvas) [canvas.style.width, canvas.style.height] = [this.#canvas.style.width, this.#canvas.style.height];
    this.#append(canvas, 'tmpi-canvas');
  }

  /** @param {Blob} file of the photo */
  showPhoto(file) {
    this.#address = URL.createObjectURL(file);
    this.poster.src = this.#address;
  }

  /** Size of the root element, CSS pixels. */
  get size() {
    return { width: this.#root.clientWidth, height: this.#root.clientHeight };
  }

  /**
   * Size of a whole picture of that aspect ratio, CSS pixels; null if the root has no area.
   * @param {number} aspect
   */
  fit(aspect) {
    return fitted(this.#root, aspect);
  }

  /**
   * Lays out the canvases at `size` and the photo as `frame` requires; all in CSS pixels.
   * @param {{width: number, height: number}} size of the pictures
   * @param {{width: number, height: number}} fit of the whole photo
   * @param {Frame} frame of the photo in the pictures
   * @param {boolean} drawn whether the photo's element shows a view from the server, which is already framed
   */
  layout(size, fit, frame, drawn) {
    for (const element of [this.poster, this.#canvas, this.#detail]) {
      if (!element) continue;
      const box = element === this.poster && !drawn ? fit : size;
      element.style.width = `${box.width}px`;
      element.style.height = `${box.height}px`;
    }
    const scale = (frame.scale * size.width) / fit.width;
    const unscaled = drawn || scale === 1;
    this.poster.style.transform = unscaled ? '' : `scale(${scale}) translate(${(0.5 - frame.x) * 100}%, ${(0.5 - frame.y) * 100}%)`;
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
  #append(element, className) {
    element.className = className;
    element.draggable = false;
    this.#root.append(element);
  }
}

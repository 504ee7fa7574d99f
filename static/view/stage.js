// What lies in the viewer's element: the photo, and over it the canvas that the scene is drawn on.
import { fitted } from './canvas-size.js';

export class Stage {
  #root;
  /** @type {HTMLCanvasElement | null} */
  #canvas = null;
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

  /** @param {Blob} file of the photo */
  showPhoto(file) {
    this.#address = URL.createObjectURL(file);
    this.poster.src = this.#address;
  }

  /**
   * Fits the pictures into the root, whole.
   * @param {number} aspect
   * @returns {{width: number, height: number} | null} their size in CSS pixels, or null where the root has no area
   */
  fit(aspect) {
    const size = fitted(this.#root, aspect);
    for (const element of size ? [this.poster, this.#canvas] : []) {
      if (!element) continue;
      element.style.width = `${size?.width}px`;
      element.style.height = `${size?.height}px`;
    }
    return size;
  }

  dispose() {
    this.poster.remove();
    this.canvas = null;
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

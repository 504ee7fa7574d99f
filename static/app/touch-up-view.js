// The two pictures of the touch-up: the photo with the outline of the strokes, and the resulting depth.

/** @import { Region } from './stroke-region.js' */

/** Colours of the covered area and of its outline: red, green, blue, opacity. */
const COVER = [255, 190, 40, 70];
const OUTLINE = [255, 190, 40, 255];

export class TouchUpView {
  #photo;
  #depth;
  #width;
  #height;
  #cover;

  /**
   * @param {HTMLCanvasElement} canvas for the photo
   * @param {HTMLCanvasElement} depth for its depth
   * @param {HTMLImageElement} photo
   * @param {number} width of both pictures
   * @param {number} height
   */
  constructor(canvas, depth, photo, width, height) {
    this.canvas = canvas;
    this.#photo = photo;
    this.#depth = depth;
    this.#width = width;
    this.#height = height;
    this.#cover = document.createElement('canvas');
    for (const one of [canvas, depth, this.#cover]) [one.width, one.height] = [width, height];
    for (const one of [canvas, depth]) one.style.setProperty('--aspect', String(width / height));
  }

  /**
   * @param {Region | null} region to show
   * @param {{at: [number, number], radius: number} | null} brush of the keyboard
   */
  draw(region, brush) {
    const context = this.canvas.getContext('2d');
    if (!context) return;
    const [w, h] = [this.#width, this.#height];
    context.imageSmoothingQuality = 'high';
    context.drawImage(this.#photo, 0, 0, w, h);
    if (region) context.drawImage(this.#covered(region), 0, 0);
    if (!brush) return;
    const [x, y] = [brush.at[0] * w, brush.at[1] * h];
    // dark around light: visible on any picture
    for (const [style, line] of /** @type {[string, number][]} */ ([
      ['#000', 4],
      ['#fff', 2],
    ])) {
      context.strokeStyle = style;
      context.lineWidth = line;
      context.beginPath();
      context.arc(x, y, Math.max(brush.radius * Math.max(w, h), 3), 0, 2 * Math.PI);
      context.moveTo(x - 4, y);
      context.lineTo(x + 4, y);
      context.moveTo(x, y - 4);
      context.lineTo(x, y + 4);
      context.stroke();
    }
  }

  /** @param {Float32Array} map disparity, 0 to 1: the nearer, the brighter */
  drawDepth(map) {
    const context = this.#depth.getContext('2d');
    if (!context) return;
    const image = context.createImageData(this.#width, this.#height);
    map.forEach((value, i) => {
      image.data.fill(255 * value, 4 * i, 4 * i + 3);
      image.data[4 * i + 3] = 255;
    });
    context.putImageData(image, 0, 0);
  }

  /** @param {Region} region */
  #covered({ x0, y0, width, height, mask }) {
    const context = this.#cover.getContext('2d');
    if (!context) return this.#cover;
    context.clearRect(0, 0, this.#width, this.#height);
    const image = context.createImageData(width, height);
    const inside = (/** @type {number} */ x, /** @type {number} */ y) => x >= 0 && y >= 0 && x < width && y < height && mask[y * width + x];
    for (let y = 0; y < height; y++) {
      for (let x = 0; x < width; x++) {
        if (!inside(x, y)) continue;
        const whole = inside(x - 1, y) && inside(x + 1, y) && inside(x, y - 1) && inside(x, y + 1);
        image.data.set(whole ? COVER : OUTLINE, 4 * (y * width + x));
      }
    }
    context.putImageData(image, x0, y0);
    return this.#cover;
  }
}

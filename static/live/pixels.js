// Reads the samples of a decoded picture, without the browser's colour conversion if possible.

import { PIXELS } from './decoder.js';

/** Timeout of copying a picture's samples, ms: in one browser the copy never finished. */
const COPY_TIMEOUT_MS = 500;
/** Most pictures that are read or wait to be: a decoder may have few of them. */
const MAX_PICTURES = 3;

/** @typedef {{format: number, bytes: Uint8Array | Uint8ClampedArray}} Pixels planes without gaps */

/** Reads and closes pictures one after another, so that none overtakes an earlier one. */
export class PictureReader {
  /** True to copy samples unconverted, false to read them from a canvas. */
  #copies = true;
  #count = 0;
  /** @type {Promise<unknown>} */
  #last = Promise.resolve();

  /** True if another picture must not wait. */
  get full() {
    return this.#count >= MAX_PICTURES;
  }

  /**
   * @param {VideoFrame | ImageBitmap} picture of that size
   * @param {{width: number, height: number}} size
   * @returns {Promise<Pixels | null>} null on a timeout; later pictures are then read from a canvas
   */
  async read(picture, size) {
    this.#count++;
    const pixels = this.#last.then(() => this.#read(picture, size));
    this.#last = pixels.catch(() => {});
    return pixels;
  }

  /**
   * @param {VideoFrame | ImageBitmap} picture
   * @param {{width: number, height: number}} size
   */
  async #read(picture, size) {
    const late = new Promise((resume) => setTimeout(() => resume(null), COPY_TIMEOUT_MS));
    try {
      const pixels = await Promise.race([pixelsOf(picture, size, this.#copies), late]);
      if (!pixels) this.#copies = false;
      return pixels;
    } finally {
      this.#count--;
      picture.close();
    }
  }
}

/**
 * The visible part of a frame's samples. Some decoders crop frames to VP9's render size, others ignore it.
 * @param {VideoFrame} picture
 * @param {number} width
 * @param {number} height
 */
function visiblePart({ visibleRect, codedWidth, codedHeight }, width, height) {
  if (visibleRect?.width === width && visibleRect.height === height) return visibleRect;
  if (codedWidth < width || codedHeight < height) throw new Error('A frame differs in size from the room.');
  return { x: 0, y: 0, width, height };
}

/**
 * @param {VideoFrame | ImageBitmap} picture of that size; the caller closes it
 * @param {{width: number, height: number}} size
 * @param {boolean} copies whether to copy the samples unconverted
 * @returns {Promise<Pixels>}
 */
export async function pixelsOf(picture, { width, height }, copies) {
  const format = 'format' in picture ? picture.format : null;
  if (copies && 'copyTo' in picture && (format === 'I420' || format === 'NV12')) {
    const rect = visiblePart(picture, width, height);
    const halfW = Math.ceil(width / 2);
    const halfH = Math.ceil(height / 2);
    const luma = { offset: 0, stride: width };
    const layout =
      format === 'NV12'
        ? [luma, { offset: width * height, stride: 2 * halfW }]
        : [luma, { offset: width * height, stride: halfW }, { offset: width * height + halfW * halfH, stride: halfW }];
    const bytes = new Uint8Array(width * height + 2 * halfW * halfH);
    await picture.copyTo(bytes, { rect, layout });
    return { format: format === 'NV12' ? PIXELS.NV12 : PIXELS.I420, bytes };
  }
  const context = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true });
  if (!context) throw new Error('the browser has no canvas for workers');
  context.drawImage(picture, 0, 0, width, height);
  return { format: PIXELS.RGBA, bytes: context.getImageData(0, 0, width, height).data };
}

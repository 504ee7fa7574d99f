// The running mean of pictures with WebGL2, as in mean-webgpu.js.
import { hasHalfFloatTargets, WebGlTarget } from '../webgl-target.js';

/** @import { copier } from '../webgl-copy.js' */

export class WebGlMean {
  #copy;
  #part;
  #sum;
  #size = [0, 0];

  /**
   * @param {WebGL2RenderingContext} gl
   * @param {ReturnType<typeof copier>} copy
   * @param {GLenum} partFormat of the pictures
   */
  constructor(gl, copy, partFormat) {
    this.#copy = copy;
    this.#part = new WebGlTarget(gl, partFormat, { depth: true });
    this.#sum = new WebGlTarget(gl, sumFormat(gl));
  }

  /**
   * The render target for the next picture.
   * @param {number} width
   * @param {number} height
   */
  part(width, height) {
    this.#size = [width, height];
    return this.#part.of(width, height).frame;
  }

  /**
   * Blends the picture into the mean with a weight.
   * @param {number} weight
   */
  add(weight) {
    const [width, height] = this.#size;
    this.#copy(this.#part.of(width, height).texture, this.#sum.of(width, height).frame, width, height, weight);
  }

  /** Writes the mean to the canvas. */
  show() {
    const [width, height] = this.#size;
    this.#copy(this.#sum.of(width, height).texture, null, width, height);
  }
}

/**
 * The most precise format that supports blending. 16-bit floats cannot represent the contribution of the last of many pictures; bytes
 * round each time, which causes visible banding but still works.
 * @param {WebGL2RenderingContext} gl
 */
function sumFormat(gl) {
  if (gl.getExtension('EXT_color_buffer_float') && gl.getExtension('EXT_float_blend')) return gl.RGBA32F;
  return hasHalfFloatTargets(gl) ? gl.RGBA16F : gl.RGBA8;
}

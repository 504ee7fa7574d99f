// Off-screen render target of WebGL2: a texture, with an optional depth buffer.

export class WebGlTarget {
  #gl;
  #format;
  #hasDepth;
  #size = [0, 0];
  /** @type {{texture: WebGLTexture, frame: WebGLFramebuffer, depth: WebGLRenderbuffer | null} | null} */
  #made = null;

  /**
   * @param {WebGL2RenderingContext} gl
   * @param {GLenum} format
   * @param {{depth?: boolean}} [options]
   */
  constructor(gl, format, { depth = false } = {}) {
    this.#gl = gl;
    this.#format = format;
    this.#hasDepth = depth;
  }

  /**
   * Texture and framebuffer of that size, recreated when the size changes.
   * @param {number} width
   * @param {number} height
   */
  of(width, height) {
    if (this.#made && this.#size[0] === width && this.#size[1] === height) return this.#made;
    this.dispose();
    const gl = this.#gl;
    this.#size = [width, height];
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.#format, width, height);
    // some devices cannot filter float textures
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
    gl.bindTexture(gl.TEXTURE_2D, null);
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    const depth = this.#hasDepth ? gl.createRenderbuffer() : null;
    if (depth) {
      gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
    }
    this.#made = { texture, frame, depth };
    return this.#made;
  }

  dispose() {
    if (!this.#made) return;
    const { texture, frame, depth } = this.#made;
    this.#gl.deleteFramebuffer(frame);
    this.#gl.deleteTexture(texture);
    this.#gl.deleteRenderbuffer(depth);
    this.#made = null;
  }
}

/**
 * Whether 16-bit float textures can be render targets.
 * @param {WebGL2RenderingContext} gl
 */
export function hasHalfFloatTargets(gl) {
  return Boolean(gl.getExtension('EXT_color_buffer_float') || gl.getExtension('EXT_color_buffer_half_float'));
}

// Copies textures with WebGL2 and copy.wgsl, between formats or with blending.

const VERTICES = 3;

/**
 * Returns a function that copies a texture to a framebuffer of the same size; with `weight`, the blend constant, it blends.
 * @param {WebGL2RenderingContext} gl
 * @param {WebGLProgram} program of copy.wgsl
 */
export function copier(gl, program) {
  return (
    /** @type {WebGLTexture} */ from,
    /** @type {WebGLFramebuffer | null} */ to,
    /** @type {number} */ width,
    /** @type {number} */ height,
    /** @type {number | undefined} */ weight = undefined,
  ) => {
    gl.bindFramebuffer(gl.FRAMEBUFFER, to);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.DEPTH_TEST);
    if (weight === undefined) gl.disable(gl.BLEND);
    else {
      gl.enable(gl.BLEND);
      gl.blendColor(weight, weight, weight, weight);
      gl.blendFunc(gl.CONSTANT_COLOR, gl.ONE_MINUS_CONSTANT_COLOR);
    }
    gl.useProgram(program);
    gl.bindTexture(gl.TEXTURE_2D, from);
    gl.drawArrays(gl.TRIANGLES, 0, VERTICES);
    gl.bindTexture(gl.TEXTURE_2D, null);
  };
}

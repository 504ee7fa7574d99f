// @ts-nocheck
// The running mean of pictures with WebGL2, as mean-webgpu.js has it.
import { program } from '../webgl-program.js';

const VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(float(gl_VertexID & 1) * 4.0 - 1.0, float(gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
uniform highp sampler2D picture;
out vec4 colour;
void main() {
  colour = texelFetch(picture, ivec2(gl_FragCoord.xy), 0);
}`;

export class WebGlMean {
  #gl;
  #program;
  #sumFormat;
  #size = [0, 0];
  #made = [];

  constructor(gl) {
    this.#gl = gl;
    // without half floats the sum rounds to eight bits each time, which shows as bands but shows
    this.#sumFormat = gl.getExtension('EXT_color_buffer_float') || gl.getExtension('EXT_color_buffer_half_float') ? gl.RGBA16F : gl.RGBA8;
    this.#program = program(gl, VERTEX, FRAGMENT);
  }

  resize(width, height) {
    if (this.#size[0] === width && this.#size[1] === height) return;
    const gl = this.#gl;
    this.#forget();
    this.#size = [width, height];
    this.part = this.#target(gl.RGBA8);
    this.sum = this.#target(this.#sumFormat);
    const depth = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.part.frame);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
    this.#made.push(() => gl.deleteRenderbuffer(depth));
  }

  #target(format) {
    const gl = this.#gl;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, ...this.#size);
    const frame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.#made.push(
      () => gl.deleteFramebuffer(frame),
      () => gl.deleteTexture(texture),
    );
    return { texture, frame };
  }

  /** Takes what was drawn into `part` into the mean, of which it is the share `weight`. */
  add(weight) {
    const gl = this.#gl;
    gl.enable(gl.BLEND);
    gl.blendColor(weight, weight, weight, weight);
    gl.blendFunc(gl.CONSTANT_COLOR, gl.ONE_MINUS_CONSTANT_COLOR);
    this.#copy(this.part.texture, this.sum.frame);
  }

  /** Writes the mean to the canvas. */
  show() {
    this.#gl.disable(this.#gl.BLEND);
    this.#copy(this.sum.texture, null);
  }

  #copy(texture, frame) {
    const gl = this.#gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.viewport(0, 0, ...this.#size);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(this.#program);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindTexture(gl.TEXTURE_2D, null);
  }

  #forget() {
    for (const remove of this.#made) remove();
    this.#made = [];
  }
}

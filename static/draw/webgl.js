// Draws a decoded scene with WebGL2 if WebGPU is not available: the same shader, translated, with the same atlas and instances.
import { WebGlMean } from './depth-of-field/mean-webgl.js';
import { COPY_FRAGMENT, COPY_VERTEX, OPAQUE_FRAGMENT, SCENE_VERTEX, SOFT_FRAGMENT } from './glsl.js';
import { INSTANCE_FLOATS, withErrors } from './instances.js';
import { checkFit, upload } from './texture-atlas.js';
import { ALL, looksBackward, UNIFORM_BYTES, VERTICES, viewUniform } from './view-uniform.js';
import { copier } from './webgl-copy.js';
import { begin, built } from './webgl-program.js';
import { hasHalfFloatTargets, WebGlTarget } from './webgl-target.js';

/** @import { Intrinsics, Scene } from '../decode/scene.js' */
/** @import { Pose, View } from '../view/camera.js' */
/** @import { Cells } from '../live/tile-atlas.js' */
/** @import { Instances } from './instances.js' */
/** @import { Strip } from './texture-atlas.js' */

/**
 * A framebuffer and its size.
 * @typedef {{framebuffer: WebGLFramebuffer | null, width: number, height: number}} Surface
 */
/** @typedef {Awaited<ReturnType<typeof load>>} Loaded */

/** Interval of polling whether the device is done, ms. */
const POLL_MS = 4;
const CONTEXT = { alpha: false, antialias: false, depth: true, powerPreference: 'high-performance' };

/**
 * The WebGL2 context of a canvas. The first call for a canvas determines its attributes.
 * @param {HTMLCanvasElement} canvas
 * @param {boolean} [over] whether undrawn pixels are transparent
 */
export const contextOf = (canvas, over = false) =>
  /** @type {WebGL2RenderingContext | null} */ (canvas.getContext('webgl2', { ...CONTEXT, alpha: over }));

/** Side of the largest texture, cached because querying it uses up one of the page's contexts; 0 if unknown. */
let knownSide = 0;

/** Side of the largest texture of the browser's WebGL2, 0 without WebGL2. */
export function webGlSide() {
  if (knownSide) return knownSide;
  const gl = contextOf(document.createElement('canvas'));
  if (!gl) return 0;
  knownSide = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  forget(gl);
  return knownSide;
}

/** A scene in a WebGL2 context. Create it with `WebGlRenderer.create`. */
export class WebGlRenderer {
  /**
   * @param {HTMLCanvasElement} canvas without a context yet
   * @param {Scene} scene
   * @param {(info: {message: string}) => void} onLost called if the context is lost
   * @throws if there is no WebGL2 or the scene does not fit it
   */
  static async create(canvas, scene, onLost) {
    const gl = contextOf(canvas);
    if (!gl) throw new Error('the browser has no WebGL2');
    try {
      const renderer = new WebGlRenderer(gl, scene, await load(gl, scene));
      if (gl.getError() !== gl.NO_ERROR) throw new Error('the scene does not fit the graphics context');
      canvas.addEventListener('webglcontextlost', () => {
        if (!renderer.disposed) onLost({ message: 'The graphics context was lost.' });
      });
      return renderer;
    } catch (error) {
      forget(gl);
      throw error;
    }
  }

  #scene;
  #loaded;
  #counts = { opaque: 0, soft: 0 };
  /** @type {WebGlTarget | null} */
  #wide = null;
  /** @type {WebGlMean | null} */
  #mean = null;

  /**
   * @param {WebGL2RenderingContext} gl
   * @param {Scene} scene
   * @param {Loaded} loaded
   */
  constructor(gl, scene, loaded) {
    this.gl = gl;
    this.context = gl;
    this.#scene = scene;
    this.#loaded = loaded;
    this.disposed = false;
    /** As `WebGpuRenderer.overlay`. */
    this.overlay = 0;
    this.maxSide = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.setTileErrors([]);
    for (let i = 0; i < 3; i++) {
      gl.enableVertexAttribArray(i);
      gl.vertexAttribDivisor(i, 1);
    }
  }

  /** As `WebGpuRenderer.wide`. */
  get wide() {
    return this.#loaded.wide;
  }

  /**
   * As `WebGpuRenderer.setTileErrors`.
   * @param {number[]} errors
   */
  setTileErrors(errors) {
    const { gl } = this;
    const { data, opaque, soft } = withErrors(this.#scene.instances, errors);
    this.#counts = { opaque, soft };
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  }

  /**
   * As `WebGpuRenderer.update`.
   * @param {{instances: Instances | null, cells: Cells}} change
   */
  update({ instances, cells: { data, places } }) {
    if (this.disposed) return;
    if (instances) {
      this.#scene.instances = instances;
      this.setTileErrors([]);
    }
    const { gl } = this;
    for (let i = 0, offset = 0; i < places.length; i += 5) {
      const [page, x, y, w, h] = places.subarray(i, i + 5);
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, x, y, page, w, h, 1, gl.RGBA, gl.UNSIGNED_BYTE, data, offset);
      offset += w * h * 4;
    }
  }

  /** Does nothing: the context belongs to its canvas. */
  attach() {}

  /**
   * As `WebGpuRenderer.draw`, by default on the canvas.
   * @param {View[]} views
   * @param {Surface} [surface]
   */
  draw(views, surface = { framebuffer: null, width: this.gl.drawingBufferWidth, height: this.gl.drawingBufferHeight }) {
    const { gl } = this;
    const { framebuffer, width, height } = surface;
    if (!this.wide) return this.#passes(views, framebuffer);
    this.#wide ??= new WebGlTarget(gl, gl.RGBA16F, { depth: true });
    const { texture, frame } = this.#wide.of(width, height);
    this.#passes(views, frame);
    this.#loaded.copy(texture, framebuffer, width, height);
  }

  /**
   * As `WebGpuRenderer.drawMean`.
   * @param {View[][]} frames
   * @param {number} before
   */
  drawMean(frames, before) {
    const { gl } = this;
    this.#mean ??= new WebGlMean(gl, this.#loaded.copy, this.wide ? gl.RGBA16F : gl.RGBA8);
    const part = this.#mean.part(gl.drawingBufferWidth, gl.drawingBufferHeight);
    frames.forEach((views, i) => {
      this.#passes(views, part);
      this.#mean?.add(1 / (before + i + 1));
    });
    this.#mean.show();
  }

  /**
   * As `WebGpuRenderer.readPixels`.
   * @param {Pose} pose
   * @param {Intrinsics} k
   * @param {number} width
   * @param {number} height
   */
  async readPixels(pose, k, width, height) {
    const { gl } = this;
    const target = new WebGlTarget(gl, gl.RGBA8, { depth: true });
    const { frame } = target.of(width, height);
    this.draw([{ pose, k, x: 0, width, height }], { framebuffer: frame, width, height });
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    const upward = new Uint8Array(width * height * 4);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upward);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    target.dispose();
    const out = new Uint8ClampedArray(upward.length);
    const row = width * 4;
    for (let y = 0; y < height; y++) out.set(upward.subarray((height - 1 - y) * row, (height - y) * row), y * row);
    return out;
  }

  /** Resolves once all submitted work is done. */
  idle() {
    return done(this.gl);
  }

  dispose() {
    this.disposed = true;
    forget(this.gl);
  }

  /**
   * Draws to a framebuffer in the scene's format.
   * @param {View[]} views
   * @param {WebGLFramebuffer | null} framebuffer
   */
  #passes(views, framebuffer) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
    views.forEach((view, i) => this.#pass(view, i === 0));
  }

  /**
   * @param {View} view
   * @param {boolean} first of those on the framebuffer
   */
  #pass(view, first) {
    const { gl } = this;
    const { opaque, soft } = this.#counts;
    gl.viewport(view.x, view.y ?? 0, view.width, view.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clearDepth(0);
    gl.depthMask(true);
    const { mask = ALL } = view;
    gl.clear(first ? gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT : gl.DEPTH_BUFFER_BIT);
    gl.bufferSubData(gl.UNIFORM_BUFFER, 0, viewUniform(this.#scene, view, nearOf, this.overlay));
    gl.colorMask(Boolean(mask & 1), Boolean(mask & 2), Boolean(mask & 4), true);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.GEQUAL);
    gl.disable(gl.BLEND);
    this.#drawFrom(this.#loaded.opaque, 0, opaque);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    this.#drawFrom(this.#loaded.soft, opaque + (looksBackward(view) ? soft : 0), soft);
    gl.colorMask(true, true, true, true);
  }

  /**
   * @param {WebGLProgram} built
   * @param {number} first
   * @param {number} count of instances
   */
  #drawFrom(built, first, count) {
    const { gl } = this;
    if (!count) return;
    gl.useProgram(built);
    const stride = INSTANCE_FLOATS * 4;
    for (let i = 0; i < 3; i++) gl.vertexAttribPointer(i, 4, gl.FLOAT, false, stride, first * stride + i * 16);
    gl.drawArraysInstanced(gl.TRIANGLES, 0, VERTICES, count);
  }
}

/**
 * Resolves once the device has finished all submitted work.
 * @param {WebGL2RenderingContext} gl
 */
async function done(gl) {
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  while (fence && gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) await new Promise((resume) => setTimeout(resume, POLL_MS));
  gl.deleteSync(fence);
}

/**
 * Uploads a scene to graphics memory. The objects that it binds stay bound.
 * @param {WebGL2RenderingContext} gl
 * @param {Scene} scene
 */
async function load(gl, scene) {
  const begun = [
    [SCENE_VERTEX, OPAQUE_FRAGMENT],
    [SCENE_VERTEX, SOFT_FRAGMENT],
    [COPY_VERTEX, COPY_FRAGMENT],
  ].map(([vertex, fragment]) => begin(gl, vertex, fragment));
  const { width, height, pages, wide: halves } = scene.atlas;
  checkFit(scene.atlas, { side: gl.getParameter(gl.MAX_TEXTURE_SIZE), pages: gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS) });
  // textures of 16-bit floats always exist, render targets may not; blending then rounds after every layer
  const wide = halves && hasHalfFloatTargets(gl);
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, gl.createTexture());
  gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, halves ? gl.RGBA16F : gl.RGBA8, width, height, pages);
  gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D_ARRAY, axis, gl.CLAMP_TO_EDGE);
  const type = halves ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE;
  const write = (/** @type {Strip} */ { page, y, h, data }) =>
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, y, page, width, h, 1, gl.RGBA, type, data);
  await upload(scene.atlas, write, () => done(gl));
  const [opaque, soft, copy] = await Promise.all(begun.map((program) => built(gl, program)));
  // before that, a query for errors would block the page
  await done(gl);
  // the programs' only uniform block is at binding 0
  gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, gl.createBuffer());
  gl.bufferData(gl.UNIFORM_BUFFER, UNIFORM_BYTES, gl.DYNAMIC_DRAW);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  return { wide, opaque, soft, copy: copier(gl, copy) };
}

/**
 * Frees the context's memory at once, not when the canvas is garbage collected.
 * @param {WebGL2RenderingContext} gl
 */
function forget(gl) {
  gl.getExtension('WEBGL_lose_context')?.loseContext();
}

/**
 * Reciprocal of the largest target disparity that is drawn. WebGL's depth buffer is not most precise at infinity, so the result is as large
 * as the camera's distance from the home position allows.
 * @param {number[]} t
 */
function nearOf(t) {
  return 0.25 * Math.max(0.004, 1 - Math.hypot(...t));
}

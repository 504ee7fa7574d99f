// @ts-nocheck
// Draws a decoded scene with WebGL2 where there is no WebGPU: tmpi.wgsl said again in GLSL, on the same pages and instances.

import { extrinsics } from '../view/camera.js';
import { WebGlMean } from './depth-of-field/mean-webgl.js';
import { INSTANCE_FLOATS, withErrors } from './instances.js';
import { upload } from './texture-atlas.js';
import { program } from './webgl-program.js';

/** @import { View } from '../view/camera.js' */

const VERTICES = 18;
/** Time between two looks at whether the device is done, ms. */
const POLL_MS = 4;

const VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec4 plane_page;
layout(location = 1) in vec4 centre_origin;
layout(location = 2) in vec4 size_atlas;
uniform mat3 rotation;
uniform vec4 t_near;
uniform vec4 k_ref;
uniform vec4 k_out;
uniform vec4 size_half;
out vec2 texel;
out float disparity;
flat out vec4 bounds;
flat out float page;
flat out vec4 overlay;

float delta_at(vec2 s) {
  vec2 uv = (s * size_atlas.xy + centre_origin.zw - centre_origin.xy) / size_half.z;
  return plane_page.x + plane_page.y * uv.x + plane_page.z * uv.y;
}

vec3 tint(vec3 v) {
  float hue = fract(sin(dot(v, vec3(12.9898, 78.233, 37.719))) * 43758.547);
  return 0.5 + 0.5 * cos(6.2831853 * (hue + vec3(0.0, 0.33, 0.67)));
}

vec3 heat(float v) {
  vec3 low = mix(vec3(0.1, 0.55, 0.35), vec3(0.95, 0.8, 0.2), min(1.0, 2.0 * v));
  return mix(low, vec3(0.85, 0.1, 0.1), max(0.0, 2.0 * v - 1.0));
}

vec4 overlay_of() {
  if (size_half.w == 1.0) return vec4(0.0, 0.0, 0.0, -1.0);
  if (size_half.w == 2.0) return vec4(tint(vec3(centre_origin.xy / size_half.z, 1.0)), 0.5);
  if (size_half.w == 3.0) return vec4(tint(plane_page.xyz), 0.5);
  if (size_half.w == 4.0) return vec4(heat(fract(plane_page.w)), 0.65);
  return vec4(0.0);
}

void main() {
  bool beyond = gl_VertexID >= 9;
  vec2 corner[4] = vec2[4](vec2(0.0, 0.0), vec2(1.0, 0.0), vec2(1.0, 1.0), vec2(0.0, 1.0));
  vec2 place[6];
  float delta[6];
  int n = 0;
  for (int k = 0; k < 4; k++) {
    vec2 a = corner[k];
    vec2 b = corner[(k + 1) % 4];
    float da = delta_at(a);
    float db = delta_at(b);
    if ((da < 0.0) == beyond) {
      place[n] = a;
      delta[n] = da;
      n++;
    }
    if ((da < 0.0) != (db < 0.0)) {
      place[n] = a + (b - a) * (da / (da - db));
      delta[n] = 0.0;
      n++;
    }
  }
  int triangle = (gl_VertexID % 9) / 3;
  int pick = triangle + 2 < n && gl_VertexID % 3 > 0 ? triangle + gl_VertexID % 3 : 0;
  bounds = vec4(floor(size_atlas.zw) + 0.5, ceil(size_atlas.zw + size_atlas.xy) - 0.5);
  page = floor(plane_page.w);
  overlay = overlay_of();
  texel = vec2(0.0);
  disparity = 0.0;
  gl_Position = vec4(0.0, 0.0, 0.0, 1.0);
  if (n < 3) return;
  texel = place[pick] * size_atlas.xy + size_atlas.zw;
  vec2 x = (place[pick] * size_atlas.xy + centre_origin.zw - k_ref.zw) / k_ref.xy;
  float d = delta[pick];
  vec3 p = rotation * vec3(x, 1.0) + t_near.xyz * d;
  vec2 pixel = k_out.xy * p.xy + k_out.zw * p.z;
  vec2 ndc = 2.0 * pixel / size_half.xy - p.z;
  float near = beyond ? 0.0 : d;
  disparity = near;
  // depth 0 is infinity here too, though the clip space of WebGL has it at -1
  gl_Position = vec4(ndc.x, -ndc.y, 2.0 * t_near.w * near - p.z, p.z);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray atlas;
uniform bool soft;
in vec2 texel;
in float disparity;
flat in vec4 bounds;
flat in float page;
flat in vec4 overlay;
out vec4 colour;
const float OPAQUE = 0.99;

void main() {
  vec2 at = clamp(texel, bounds.xy, bounds.zw) / vec2(textureSize(atlas, 0).xy);
  vec4 c = textureLod(atlas, vec3(at, page), 0.0);
  if (soft ? c.a >= OPAQUE || c.a <= 0.0 : c.a < OPAQUE) discard;
  if (!soft) c = vec4(c.rgb / c.a, 1.0);
  vec3 over = overlay.w < 0.0 ? vec3(c.a * min(1.0, disparity * gl_FragCoord.w)) : mix(c.rgb, overlay.rgb * c.a, overlay.w);
  colour = vec4(over, c.a);
}`;

const CONTEXT = { alpha: false, antialias: false, depth: true, powerPreference: 'high-performance' };

/** Whether the browser has WebGL2. */
export function hasWebGl() {
  const gl = document.createElement('canvas').getContext('webgl2', CONTEXT);
  gl?.getExtension('WEBGL_lose_context')?.loseContext();
  return Boolean(gl);
}

/** A scene in a WebGL2 context. Build with `WebGlRenderer.create`. */
export class WebGlRenderer {
  /**
   * @param {HTMLCanvasElement} canvas without a context yet
   * @param {Scene} scene
   * @param {(info: {message: string}) => void} onLost called where the context goes away by itself
   * @throws where there is no WebGL2 or the scene does not fit it
   */
  static async create(canvas, scene, onLost) {
    const gl = canvas.getContext('webgl2', CONTEXT);
    if (!gl) throw new Error('the browser has no WebGL2');
    const renderer = new WebGlRenderer(gl, scene);
    try {
      await renderer.#build();
    } catch (error) {
      renderer.dispose();
      throw error;
    }
    canvas.addEventListener('webglcontextlost', () => {
      if (!renderer.disposed) onLost({ message: 'The graphics context was lost.' });
    });
    return renderer;
  }

  constructor(gl, scene) {
    this.gl = gl;
    this.context = gl;
    this.scene = scene;
    this.disposed = false;
    this.overlay = 0;
    this.maxSide = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  }

  async #build() {
    const { gl, scene } = this;
    this.program = program(gl, VERTEX, FRAGMENT);
    const names = ['rotation', 't_near', 'k_ref', 'k_out', 'size_half', 'soft'];
    this.at = Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(this.program, name)]));
    const { width, height, pages } = scene.atlas;
    const most = { side: this.maxSide, pages: gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS) };
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, gl.createTexture());
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA8, width, height, pages);
    gl.texParameteri(gl.TEXTURE_2D_ARRAY, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D_ARRAY, axis, gl.CLAMP_TO_EDGE);
    await upload(scene.atlas, most, ({ page, y, h, data }) => {
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, y, page, width, h, 1, gl.RGBA, gl.UNSIGNED_BYTE, data);
    });
    this.atlasBytes = width * height * pages * 4;
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    this.setTileErrors([]);
    for (let i = 0; i < 3; i++) {
      gl.enableVertexAttribArray(i);
      gl.vertexAttribDivisor(i, 1);
    }
    if (gl.getError() !== gl.NO_ERROR) throw new Error('the scene does not fit the graphics context');
  }

  /** As `WebGpuRenderer.setTileErrors`. */
  setTileErrors(errors) {
    const { gl } = this;
    const { data, opaque, soft } = withErrors(this.scene.instances, errors);
    this.counts = { opaque, soft };
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
  }

  /** The canvas was given when the context was made. */
  attach() {}

  /**
   * As `WebGpuRenderer.draw`; `framebuffer` where it is not the canvas's.
   * @param {View[]} views
   * @param {WebGLFramebuffer | null} [framebuffer]
   */
  draw(views, framebuffer = null) {
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, framebuffer);
    views.forEach((view, i) => this.#pass(view, i === 0));
  }

  /** As `WebGpuRenderer.drawMean`. */
  drawMean(frames, before) {
    const { gl } = this;
    this.mean ??= new WebGlMean(gl);
    this.mean.resize(gl.canvas.width, gl.canvas.height);
    frames.forEach((views, i) => {
      this.draw(views, this.mean.part.frame);
      this.mean.add(1 / (before + i + 1));
    });
    this.mean.show();
  }

  #pass({ pose, k, x, y = 0, width, height }, first) {
    const { gl, at, scene, counts } = this;
    const { r, t } = extrinsics(pose);
    const { intrinsics, tileSize } = scene;
    gl.viewport(x, y, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clearDepth(0);
    gl.depthMask(true);
    gl.clear(first ? gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT : gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.program);
    // row-major here, column by column there
    gl.uniformMatrix3fv(at.rotation, true, r);
    gl.uniform4f(at.t_near, ...t, nearOf(t));
    gl.uniform4f(at.k_ref, intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy);
    gl.uniform4f(at.k_out, k.fx, k.fy, k.cx, k.cy);
    gl.uniform4f(at.size_half, width, height, tileSize / 2, this.overlay);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.GEQUAL);
    gl.disable(gl.BLEND);
    this.#drawFrom(0, counts.opaque, 0);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    this.#drawFrom(counts.opaque, counts.soft, 1);
  }

  #drawFrom(first, count, soft) {
    const { gl } = this;
    if (!count) return;
    gl.uniform1i(this.at.soft, soft);
    const stride = INSTANCE_FLOATS * 4;
    for (let i = 0; i < 3; i++) gl.vertexAttribPointer(i, 4, gl.FLOAT, false, stride, first * stride + i * 16);
    gl.drawArraysInstanced(gl.TRIANGLES, 0, VERTICES, count);
  }

  /** Draws apart from the canvas and reads the picture back: premultiplied RGBA, row by row. */
  async readPixels(pose, k, width, height) {
    const { gl } = this;
    const target = gl.createFramebuffer();
    const buffers = [gl.createRenderbuffer(), gl.createRenderbuffer()];
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    [
      [gl.RGBA8, gl.COLOR_ATTACHMENT0],
      [gl.DEPTH_COMPONENT24, gl.DEPTH_ATTACHMENT],
    ].forEach(([format, attachment], i) => {
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffers[i]);
      gl.renderbufferStorage(gl.RENDERBUFFER, format, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, attachment, gl.RENDERBUFFER, buffers[i]);
    });
    this.#pass({ pose, k, x: 0, width, height }, true);
    const upward = new Uint8Array(width * height * 4);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, upward);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.deleteFramebuffer(target);
    for (const buffer of buffers) gl.deleteRenderbuffer(buffer);
    const out = new Uint8ClampedArray(upward.length);
    const row = width * 4;
    for (let y = 0; y < height; y++) out.set(upward.subarray((height - 1 - y) * row, (height - y) * row), y * row);
    return out;
  }

  /** Resolves once everything submitted so far is drawn. */
  async idle() {
    const { gl } = this;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (fence && gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) await new Promise((resume) => setTimeout(resume, POLL_MS));
    gl.deleteSync(fence);
  }

  dispose() {
    this.disposed = true;
    // the context's memory goes at once, not when the canvas is collected
    this.gl.getExtension('WEBGL_lose_context')?.loseContext();
  }
}

/**
 * Reciprocal of the greatest target disparity that is drawn. WebGL's depth is not at its finest at infinity, so it is as large as
 * the camera's way from the photo's own place allows.
 */
function nearOf(t) {
  return 0.25 * Math.max(0.004, 1 - Math.hypot(...t));
}

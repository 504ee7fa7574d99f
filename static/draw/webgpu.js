// @ts-nocheck
// Draws a decoded scene with WebGPU by tmpi.wgsl, the shader that the server's gpu host uses too; its header is the contract.

import { extrinsics } from '../view/camera.js';
import { WebGpuMean } from './depth-of-field/mean-webgpu.js';
import { acquireDevice } from './device.js';
import { INSTANCE_FLOATS, withErrors } from './instances.js';
import { upload } from './texture-atlas.js';

/** @import { Intrinsics, Scene } from '../decode/scene.js' */
/** @import { Pose, View } from '../view/camera.js' */

const UNIFORM_BYTES = 112;
const INSTANCE_BYTES = INSTANCE_FLOATS * 4;
const VERTICES = 18;
/** Disparity 1/NEAR is the nearest that is drawn. */
const NEAR = 1e-3;
const DEPTH_FORMAT = 'depth32float';

/** @type {Promise<string> | null} */
let shaderText = null;

function loadShader() {
  if (shaderText) return shaderText;
  const text = fetch(new URL('./tmpi.wgsl', import.meta.url)).then((response) => {
    if (!response.ok) throw new Error('the shader cannot be loaded');
    return response.text();
  });
  text.catch(() => (shaderText = null));
  shaderText = text;
  return text;
}

/** A scene on a graphics device. Build with `WebGpuRenderer.create`. */
export class WebGpuRenderer {
  /**
   * @param {Scene} scene
   * @param {(info: GPUDeviceLostInfo) => void} onLost called once where the device goes away by itself
   * @throws where there is no device or the scene does not fit it
   */
  static async create(scene, onLost) {
    const device = await acquireDevice();
    const renderer = new WebGpuRenderer(device, scene, onLost);
    try {
      await device.build(() => renderer.#build());
    } catch (error) {
      renderer.dispose();
      throw error;
    }
    return renderer;
  }

  constructor(shared, scene, onLost) {
    this.shared = shared;
    this.device = shared.handle;
    this.scene = scene;
    this.maxSide = this.device.limits.maxTextureDimension2D;
    /** What is drawn over the scene, one of `OVERLAYS`. */
    this.overlay = 0;
    this.format = navigator.gpu.getPreferredCanvasFormat();
    this.disposed = false;
    this.depth = /** @type {GPUTexture | null} */ (null);
    this.mean = /** @type {WebGpuMean | null} */ (null);
    this.context = /** @type {GPUCanvasContext | null} */ (null);
    this.device.lost.then((info) => {
      if (!this.disposed) onLost(info);
    });
  }

  async #build() {
    const { device, shared } = this;
    if (!shared.pipelines.has(this.format)) shared.pipelines.set(this.format, pipelines(device, this.format));
    const { bindings, opaque, soft } = await shared.pipelines.get(this.format);
    this.opaque = opaque;
    this.soft = soft;
    this.uniforms = device.createBuffer({ size: UNIFORM_BYTES, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
    await this.#upload(this.scene.atlas);
    this.#list([]);
    this.bindings = device.createBindGroup({
      layout: bindings,
      entries: [
        { binding: 0, resource: { buffer: this.uniforms } },
        { binding: 1, resource: this.atlas.createView({ dimension: '2d-array' }) },
        { binding: 2, resource: device.createSampler({ magFilter: 'linear', minFilter: 'linear' }) },
      ],
    });
  }

  async #upload(atlas) {
    const { device } = this;
    const { width, height, pages } = atlas;
    const most = { side: device.limits.maxTextureDimension2D, pages: device.limits.maxTextureArrayLayers };
    this.atlas = device.createTexture({
      size: [width, height, pages],
      format: 'rgba8unorm',
      usage: GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_DST,
    });
    const bytesPerRow = width * 4;
    await upload(atlas, most, ({ page, y, h, data }) => {
      device.queue.writeTexture({ texture: this.atlas, origin: [0, y, page] }, data, { bytesPerRow }, [width, h, 1]);
    });
    this.atlasBytes = width * height * pages * 4;
  }

  /** Parallax error in pixels of each tile, for the overlay that shows it. */
  setTileErrors(errors) {
    if (!this.disposed) this.#list(errors);
  }

  #list(errors) {
    const { data, opaque, soft } = withErrors(this.scene.instances, errors);
    this.counts = { opaque, soft };
    const size = Math.max(data.byteLength, INSTANCE_BYTES);
    this.instances ??= this.device.createBuffer({ size, usage: GPUBufferUsage.VERTEX | GPUBufferUsage.COPY_DST });
    this.device.queue.writeBuffer(this.instances, 0, data);
  }

  /** Makes `canvas` show what `draw` draws. */
  attach(canvas) {
    const context = canvas.getContext('webgpu');
    if (!context) throw new Error('the canvas has no WebGPU context');
    context.configure({ device: this.device, format: this.format, alphaMode: 'opaque' });
    this.context = context;
  }

  /**
   * Draws to the attached canvas.
   * @param {{pose: object, k: object, x: number, width: number, height: number}[]} views side by side: pose and target intrinsics
   *   of each, and its place on the canvas
   */
  draw(views) {
    const texture = this.context.getCurrentTexture();
    views.forEach((view, i) => this.#pass(texture, view, i === 0));
  }

  /**
   * Draws the mean of pictures to the attached canvas, going on from a mean of `before` pictures drawn the same way just now.
   * @param {{pose: object, k: object, x: number, width: number, height: number}[][]} frames views of each picture, as `draw` has them
   */
  drawMean(frames, before) {
    const texture = this.context.getCurrentTexture();
    this.mean ??= new WebGpuMean(this.device, this.format);
    this.mean.resize(texture.width, texture.height);
    frames.forEach((views, i) => {
      views.forEach((view, j) => this.#pass(this.mean.part, view, j === 0));
      this.mean.add(1 / (before + i + 1));
    });
    this.mean.show(texture);
  }

  #pass(texture, view, first, after) {
    const { device } = this;
    const { width, height } = texture;
    if (this.depth?.width !== width || this.depth?.height !== height) {
      this.depth?.destroy();
      this.depth = device.createTexture({ size: [width, height], format: DEPTH_FORMAT, usage: GPUTextureUsage.RENDER_ATTACHMENT });
    }
    device.queue.writeBuffer(this.uniforms, 0, viewUniform(this.scene, view.pose, view.k, view.width, view.height, this.overlay));
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginRenderPass({
      colorAttachments: [{ view: texture.createView(), clearValue: [0, 0, 0, 0], loadOp: first ? 'clear' : 'load', storeOp: 'store' }],
      depthStencilAttachment: { view: this.depth.createView(), depthClearValue: 0, depthLoadOp: 'clear', depthStoreOp: 'discard' },
    });
    pass.setViewport(view.x, 0, view.width, view.height, 0, 1);
    pass.setBindGroup(0, this.bindings);
    if (this.counts.opaque) {
      pass.setPipeline(this.opaque);
      pass.setVertexBuffer(0, this.instances);
      pass.draw(VERTICES, this.counts.opaque);
    }
    if (this.counts.soft) {
      pass.setPipeline(this.soft);
      pass.setVertexBuffer(0, this.instances, this.counts.opaque * INSTANCE_BYTES);
      pass.draw(VERTICES, this.counts.soft);
    }
    pass.end();
    after?.(encoder);
    device.queue.submit([encoder.finish()]);
  }

  /** Draws apart from the canvas and reads the picture back: premultiplied RGBA, row by row. */
  async readPixels(pose, k, width, height) {
    const { device } = this;
    const texture = device.createTexture({
      size: [width, height],
      format: this.format,
      usage: GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC,
    });
    // rows of a copy start at multiples of 256 bytes
    const bytesPerRow = Math.ceil((width * 4) / 256) * 256;
    const buffer = device.createBuffer({ size: bytesPerRow * height, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
    try {
      this.#pass(texture, { pose, k, x: 0, width, height }, true, (encoder) =>
        encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow }, [width, height]),
      );
      await buffer.mapAsync(GPUMapMode.READ);
      return tightRows(new Uint8Array(buffer.getMappedRange()), width, height, bytesPerRow, this.format.startsWith('bgra'));
    } finally {
      texture.destroy();
      buffer.destroy();
    }
  }

  /** Resolves once everything submitted so far is drawn. */
  idle() {
    return this.device.queue.onSubmittedWorkDone();
  }

  dispose() {
    if (this.disposed) return;
    this.disposed = true;
    this.context?.unconfigure();
    this.mean?.dispose();
    for (const resource of [this.atlas, this.instances, this.uniforms, this.depth]) resource?.destroy();
    this.shared.release();
  }
}

/** Layout of the bindings and the pipelines of both passes. */
async function pipelines(device, format) {
  const module = device.createShaderModule({ code: await loadShader() });
  const bindings = device.createBindGroupLayout({
    entries: [
      { binding: 0, visibility: GPUShaderStage.VERTEX, buffer: { type: 'uniform' } },
      { binding: 1, visibility: GPUShaderStage.FRAGMENT, texture: { sampleType: 'float', viewDimension: '2d-array' } },
      { binding: 2, visibility: GPUShaderStage.FRAGMENT, sampler: { type: 'filtering' } },
    ],
  });
  const layout = device.createPipelineLayout({ bindGroupLayouts: [bindings] });
  const over = { srcFactor: 'one', dstFactor: 'one-minus-src-alpha', operation: 'add' };
  const pipeline = (entryPoint, depthWriteEnabled, blend) =>
    device.createRenderPipelineAsync({
      layout,
      vertex: { module, entryPoint: 'vs', buffers: [instanceLayout()] },
      fragment: { module, entryPoint, targets: [{ format, blend }] },
      primitive: { topology: 'triangle-list', cullMode: 'none' },
      depthStencil: { format: DEPTH_FORMAT, depthWriteEnabled, depthCompare: 'greater-equal' },
    });
  const [opaque, soft] = await Promise.all([
    pipeline('fs_opaque', true, undefined),
    pipeline('fs_soft', false, { color: over, alpha: over }),
  ]);
  return { bindings, opaque, soft };
}

function instanceLayout() {
  const attribute = (shaderLocation) => ({ shaderLocation, offset: shaderLocation * 16, format: 'float32x4' });
  return { arrayStride: INSTANCE_BYTES, stepMode: 'instance', attributes: [0, 1, 2].map(attribute) };
}

function viewUniform({ intrinsics, tileSize }, pose, k, width, height, overlay) {
  const { r, t } = extrinsics(pose);
  const column = (j) => [r[j], r[3 + j], r[6 + j], 0];
  const camera = (c) => [c.fx, c.fy, c.cx, c.cy];
  const rest = [...t, NEAR, ...camera(intrinsics), ...camera(k), width, height, tileSize / 2, overlay];
  return new Float32Array([...column(0), ...column(1), ...column(2), ...rest]);
}

function tightRows(padded, width, height, bytesPerRow, swap) {
  const out = new Uint8ClampedArray(width * height * 4);
  for (let y = 0; y < height; y++) out.set(padded.subarray(y * bytesPerRow, y * bytesPerRow + width * 4), y * width * 4);
  if (swap) for (let i = 0; i < out.length; i += 4) [out[i], out[i + 2]] = [out[i + 2], out[i]];
  return out;
}

// Draws a decoded scene with WebGPU and tmpi.wgsl, the shader of the server's gpu backend; its header specifies buffers and passes.
import { WebGpuMean } from './depth-of-field/mean-webgpu.js';
import { acquireDevice } from './device.js';
import { INSTANCE_FLOATS, withErrors } from './instances.js';
import { checkFit, upload } from './texture-atlas.js';
import { ALL, looksBackward, UNIFORM_BYTES, VERTICES, viewUniform } from './view-uniform.js';
import { copyPipeline, copyTexture } from './webgpu-copy.js';

/** @import { Intrinsics, Scene } from '../decode/scene.js' */
/** @import { Pose, View } from '../view/camera.js' */
/** @import { Cells } from '../live/tile-atlas.js' */
/** @import { Device } from './device.js' */
/** @import { Instances } from './instances.js' */
/** @import { Strip } from './texture-atlas.js' */

const INSTANCE_BYTES = INSTANCE_FLOATS * 4;
/** The largest disparity that is drawn is 1/NEAR. */
const NEAR = 1 / 1024;
const DEPTH_FORMAT = 'depth32float';
/** Format of texels and views if soft layers are stacked: 8 bits would round after every layer. */
const WIDE_FORMAT = 'rgba16float';

/** @typedef {{scene: GPUShaderModule, copy: GPUShaderModule, layout: GPUBindGroupLayout}} Shaders */
/** @typedef {{opaque: GPURenderPipeline, soft: GPURenderPipeline}} Passes */
/** @typedef {Awaited<ReturnType<typeof load>>} Loaded */

/** A scene on a graphics device. Create it with `WebGpuRenderer.create`. */
export class WebGpuRenderer {
  /**
   * @param {Scene} scene
   * @param {(info: GPUDeviceLostInfo) => void} onLost called once if the device is lost
   * @throws if there is no device or the scene does not fit it
   */
  static async create(scene, onLost) {
    const device = await acquireDevice();
    /** @type {WebGpuRenderer[]} */
    const made = [];
    try {
      await device.build(async () => {
        made.push(new WebGpuRenderer(device, scene, await load(device, scene), onLost));
      });
    } catch (error) {
      if (made.length) made[0].dispose();
      else device.release();
      throw error;
    }
    return made[0];
  }

  #scene;
  #loaded;
  /** @type {{buffer: GPUBuffer, opaque: number, soft: number} | null} */
  #instances = null;
  /** @type {GPUTexture | null} */
  #depth = null;
  /** @type {GPUTexture | null} */
  #wide = null;
  /** @type {WebGpuMean | null} */
  #mean = null;

  /**
   * @param {Device} shared
   * @param {Scene} scene
   * @param {Loaded} loaded
   * @param {(info: GPUDeviceLostInfo) => void} onLost
   */
  constructor(shared, scene, loaded, onLost) {
    this.shared = shared;
    this.device = shared.handle;
    this.#scene = scene;
    this.#loaded = loaded;
    this.maxSide = this.device.limits.maxTextureDimension2D;
    /** Overlay over the scene: an index into `OVERLAYS`. */
    this.overlay = 0;
    this.disposed = false;
    /** @type {GPUCanvasContext | null} */
    this.context = null;
    this.setTileErrors([]);
    this.device.lost.then((info) => {
      if (!this.disposed) onLost(info);
    });
  }

  /** True if the scene is drawn in 16-bit floats and rounded at the end. */
  get wide() {
    return this.#loaded.wide;
  }

  /**
   * Sets the parallax error of each tile in pixels, for the overlay `error`.
   * @param {number[]} errors
   */
  setTileErrors(errors) {
    if (this.disposed) return;
    const { data, opaque, soft } = withErrors(this.#scene.instances, errors);
    const size = Math.max(data.byteLength, INSTANCE_BYTES);
    const old = this.#instances?.buffer;
    const usage = GPUBufferUsage.VERTEX | GPUBufferUsage.COPY_DST;
    const buffer = old && old.size >= size ? old : this.device.createBuffer({ size, usage });
    if (buffer !== old) old?.destroy();
    this.#instances = { buffer, opaque, soft };
    this.device.queue.writeBuffer(buffer, 0, data);
  }

  /**
   * Applies changed texels, and new instances if there are any.
   * @param {{instances: Instances | null, cells: Cells}} change
   */
  update({ instances, cells: { data, places } }) {
    if (this.disposed) return;
    if (instances) {
      this.#scene.instances = instances;
      this.setTileErrors([]);
    }
    for (let i = 0, offset = 0; i < places.length; i += 5) {
      const [page, x, y, w, h] = places.subarray(i, i + 5);
      const to = { texture: this.#loaded.atlas, origin: [x, y, page] };
      this.device.queue.writeTexture(to, data, { offset, bytesPerRow: w * 4 }, [w, h, 1]);
      offset += w * h * 4;
    }
  }

  /**
   * Makes `draw` draw on `canvas`.
   * @param {HTMLCanvasElement} canvas
   * @param {boolean} [over] whether undrawn pixels are transparent
   */
  attach(canvas, over = false) {
    const context = canvas.getContext('webgpu');
    if (!context) throw new Error('the canvas has no WebGPU context');
    context.configure({ device: this.device, format: this.#loaded.format, alphaMode: over ? 'premultiplied' : 'opaque' });
    this.context = context;
  }

  /**
   * Draws to the attached canvas.
   * @param {View[]} views side by side
   */
  draw(views) {
    if (this.context) this.#draw(views, this.context.getCurrentTexture());
  }

  /**
   * Draws the mean of pictures on the attached canvas, continuing the mean of `before` pictures from the preceding calls.
   * @param {View[][]} frames views of each picture, as in `draw`
   * @param {number} before
   */
  drawMean(frames, before) {
    if (!this.context) return;
    const texture = this.context.getCurrentTexture();
    const { copy, target, format } = this.#loaded;
    this.#mean ??= new WebGpuMean(this.device, copy, target, format);
    const part = this.#mean.part(texture.width, texture.height);
    frames.forEach((views, i) => {
      this.#passes(views, part);
      this.#mean?.add(1 / (before + i + 1));
    });
    this.#mean.show(texture);
  }

  /**
   * Draws off screen and reads the picture back.
   * @param {Pose} pose
   * @param {Intrinsics} k
   * @param {number} width
   * @param {number} height
   * @returns {Promise<Uint8ClampedArray<ArrayBuffer>>} premultiplied RGBA, row by row
   */
  async readPixels(pose, k, width, height) {
    const { device } = this;
    const { format } = this.#loaded;
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC;
    const texture = device.createTexture({ size: [width, height], format, usage });
    // rows of a copy start at multiples of 256 bytes
    const bytesPerRow = Math.ceil((width * 4) / 256) * 256;
    const buffer = device.createBuffer({ size: bytesPerRow * height, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
    try {
      this.#draw([{ pose, k, x: 0, width, height }], texture);
      const encoder = device.createCommandEncoder();
      encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow }, [width, height]);
      device.queue.submit([encoder.finish()]);
      await buffer.mapAsync(GPUMapMode.READ);
      return tightRows(new Uint8Array(buffer.getMappedRange()), width, height, bytesPerRow, format.startsWith('bgra'));
    } finally {
      texture.destroy();
      buffer.destroy();
    }
  }

  /** Resolves once all submitted work is done. */
  idle() {
    return this.device.queue.onSubmittedWorkDone();
  }

  dispose() {
    if (this.disposed) return;
    this.disposed = true;
    this.context?.unconfigure();
    this.#mean?.dispose();
    this.#loaded.dispose();
    for (const resource of [this.#instances?.buffer, this.#depth, this.#wide]) resource?.destroy();
    this.shared.release();
  }

  /**
   * Draws to a texture in the canvas's format.
   * @param {View[]} views
   * @param {GPUTexture} texture
   */
  #draw(views, texture) {
    const { wide, round } = this.#loaded;
    if (!wide) return this.#passes(views, texture);
    const { width, height } = texture;
    if (this.#wide?.width !== width || this.#wide?.height !== height) {
      this.#wide?.destroy();
      const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.TEXTURE_BINDING;
      this.#wide = this.device.createTexture({ size: [width, height], format: WIDE_FORMAT, usage });
    }
    this.#passes(views, this.#wide);
    copyTexture(this.device, round, this.#wide, texture);
  }

  /**
   * Draws to a texture in the scene's format.
   * @param {View[]} views
   * @param {GPUTexture} texture
   */
  #passes(views, texture) {
    const { device } = this;
    const { width, height } = texture;
    if (this.#depth?.width !== width || this.#depth?.height !== height) {
      this.#depth?.destroy();
      this.#depth = device.createTexture({ size: [width, height], format: DEPTH_FORMAT, usage: GPUTextureUsage.RENDER_ATTACHMENT });
    }
    const depth = this.#depth.createView();
    views.forEach((view, i) => this.#pass(texture.createView(), depth, view, i === 0));
  }

  /**
   * @param {GPUTextureView} texture
   * @param {GPUTextureView} depth
   * @param {View} view
   * @param {boolean} first of those on the texture
   */
  #pass(texture, depth, view, first) {
    const { device } = this;
    const { uniforms, bindings, passesFor } = this.#loaded;
    if (!this.#instances) return;
    const passes = passesFor(view.mask ?? ALL);
    const { buffer, opaque, soft } = this.#instances;
    device.queue.writeBuffer(
      uniforms,
      0,
      viewUniform(this.#scene, view, () => NEAR, this.overlay),
    );
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginRenderPass({
      colorAttachments: [{ view: texture, clearValue: [0, 0, 0, 0], loadOp: first ? 'clear' : 'load', storeOp: 'store' }],
      depthStencilAttachment: { view: depth, depthClearValue: 0, depthLoadOp: 'clear', depthStoreOp: 'discard' },
    });
    pass.setViewport(view.x, 0, view.width, view.height, 0, 1);
    pass.setBindGroup(0, bindings);
    pass.setVertexBuffer(0, buffer);
    if (opaque) {
      pass.setPipeline(passes.opaque);
      pass.draw(VERTICES, opaque);
    }
    if (soft) {
      pass.setPipeline(passes.soft);
      pass.draw(VERTICES, soft, 0, opaque + (looksBackward(view) ? soft : 0));
    }
    pass.end();
    device.queue.submit([encoder.finish()]);
  }
}

/**
 * Uploads a scene to graphics memory.
 * @param {Device} shared
 * @param {Scene} scene
 */
async function load(shared, scene) {
  const device = shared.handle;
  const format = navigator.gpu.getPreferredCanvasFormat();
  const { width, height, pages, wide } = scene.atlas;
  const most = { side: device.limits.maxTextureDimension2D, pages: device.limits.maxTextureArrayLayers };
  checkFit(scene.atlas, most);
  const target = wide ? WIDE_FORMAT : format;
  const { scene: module, copy, layout } = await shared.once('shaders', () => shadersOf(device));
  /** @type {Map<number, Passes>} */
  const passes = new Map([[ALL, await shared.once(target, () => passesOf(device, module, layout, target))]]);
  /** The passes that draw some of the channels. */
  const passesFor = (/** @type {number} */ mask) => {
    const known = passes.get(mask);
    if (known) return known;
    const { opaque, soft } = pipelines(device, module, layout, target, mask);
    const made = { opaque: device.createRenderPipeline(opaque), soft: device.createRenderPipeline(soft) };
    passes.set(mask, made);
    return made;
  };
  const uniforms = device.createBuffer({ size: UNIFORM_BYTES, usage: GPUBufferUsage.UNIFORM | GPUBufferUsage.COPY_DST });
  const atlas = device.createTexture({
    size: [width, height, pages],
    format: wide ? WIDE_FORMAT : 'rgba8unorm',
    usage: GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_DST,
  });
  const dispose = () => {
    uniforms.destroy();
    atlas.destroy();
  };
  try {
    const bytesPerRow = width * (wide ? 8 : 4);
    const write = (/** @type {Strip} */ { page, y, h, data }) =>
      device.queue.writeTexture({ texture: atlas, origin: [0, y, page] }, data, { bytesPerRow }, [width, h, 1]);
    await upload(scene.atlas, write, () => device.queue.onSubmittedWorkDone());
  } catch (error) {
    dispose();
    throw error;
  }
  const bindings = device.createBindGroup({
    layout,
    entries: [
      { binding: 0, resource: { buffer: uniforms } },
      { binding: 1, resource: atlas.createView({ dimension: '2d-array' }) },
      { binding: 2, resource: device.createSampler({ magFilter: 'linear', minFilter: 'linear' }) },
    ],
  });
  const round = copyPipeline(device, copy, format);
  return { format, target, wide, atlas, uniforms, bindings, passesFor, copy, round, dispose };
}

/** @param {URL} address */
async function textOf(address) {
  const response = await fetch(address);
  if (!response.ok) throw new Error('the shader cannot be loaded');
  return response.text();
}

/**
 * @param {GPUDevice} device
 * @returns {Promise<Shaders>}
 */
async function shadersOf(device) {
  const [scene, copy] = await Promise.all([
    textOf(new URL('./tmpi.wgsl', import.meta.url)),
    textOf(new URL('./copy.wgsl', import.meta.url)),
  ]);
  const layout = device.createBindGroupLayout({
    entries: [
      { binding: 0, visibility: GPUShaderStage.VERTEX, buffer: { type: 'uniform' } },
      { binding: 1, visibility: GPUShaderStage.FRAGMENT, texture: { sampleType: 'float', viewDimension: '2d-array' } },
      { binding: 2, visibility: GPUShaderStage.FRAGMENT, sampler: { type: 'filtering' } },
    ],
  });
  return { scene: device.createShaderModule({ code: scene }), copy: device.createShaderModule({ code: copy }), layout };
}

/**
 * The pipelines of pass 1 and pass 2 for a target in that format.
 * @param {GPUDevice} device
 * @param {GPUShaderModule} module
 * @param {GPUBindGroupLayout} bindings
 * @param {GPUTextureFormat} format
 * @returns {Promise<Passes>}
 */
async function passesOf(device, module, bindings, format) {
  const described = pipelines(device, module, bindings, format, ALL);
  const [opaque, soft] = await Promise.all([described.opaque, described.soft].map((one) => device.createRenderPipelineAsync(one)));
  return { opaque, soft };
}

/**
 * Describes the pipelines of pass 1 and pass 2 that draw the channels of `mask` (view/camera.js).
 * @param {GPUDevice} device
 * @param {GPUShaderModule} module
 * @param {GPUBindGroupLayout} bindings
 * @param {GPUTextureFormat} format
 * @param {number} mask
 */
function pipelines(device, module, bindings, format, mask) {
  const layout = device.createPipelineLayout({ bindGroupLayouts: [bindings] });
  /** @type {GPUBlendComponent} */
  const over = { srcFactor: 'one', dstFactor: 'one-minus-src-alpha', operation: 'add' };
  /** @type {GPUVertexAttribute[]} */
  const attributes = [0, 1, 2].map((shaderLocation) => ({ shaderLocation, offset: shaderLocation * 16, format: 'float32x4' }));
  const pipeline = (
    /** @type {string} */ entryPoint,
    /** @type {boolean} */ depthWriteEnabled,
    /** @type {GPUBlendState | undefined} */ blend = undefined,
  ) =>
    /** @type {GPURenderPipelineDescriptor} */ ({
      layout,
      vertex: { module, entryPoint: 'vs', buffers: [{ arrayStride: INSTANCE_BYTES, stepMode: 'instance', attributes }] },
      fragment: { module, entryPoint, targets: [{ format, writeMask: mask | GPUColorWrite.ALPHA, ...(blend && { blend }) }] },
      primitive: { topology: 'triangle-list', cullMode: 'none' },
      depthStencil: { format: DEPTH_FORMAT, depthWriteEnabled, depthCompare: 'greater-equal' },
    });
  return { opaque: pipeline('fs_opaque', true), soft: pipeline('fs_soft', false, { color: over, alpha: over }) };
}

/**
 * @param {Uint8Array} padded
 * @param {number} width
 * @param {number} height
 * @param {number} bytesPerRow
 * @param {boolean} swap whether to swap red and blue
 */
function tightRows(padded, width, height, bytesPerRow, swap) {
  const out = new Uint8ClampedArray(width * height * 4);
  for (let y = 0; y < height; y++) out.set(padded.subarray(y * bytesPerRow, y * bytesPerRow + width * 4), y * width * 4);
  if (swap) for (let i = 0; i < out.length; i += 4) [out[i], out[i + 2]] = [out[i + 2], out[i]];
  return out;
}

// The running mean of pictures with WebGPU: each picture is drawn into `part` and blended into a sum with its weight.
import { copyPipeline, copyTexture } from '../webgpu-copy.js';

/** @type {GPUBlendComponent} */
const WEIGHED = { srcFactor: 'constant', dstFactor: 'one-minus-constant', operation: 'add' };

export class WebGpuMean {
  #device;
  #add;
  #show;
  #sumFormat;
  /** @type {GPUTexture | null} */
  #sum = null;
  /**
   * The render target for the next picture.
   * @type {GPUTexture | null}
   */
  #part = null;

  /**
   * @param {GPUDevice} device
   * @param {GPUShaderModule} copy of copy.wgsl
   * @param {GPUTextureFormat} partFormat of the pictures
   * @param {GPUTextureFormat} format of the texture that shows their mean
   */
  constructor(device, copy, partFormat, format) {
    this.#device = device;
    this.partFormat = partFormat;
    // 16-bit floats cannot represent the contribution of the last of many pictures
    this.#sumFormat = /** @type {GPUTextureFormat} */ (device.features.has('float32-blendable') ? 'rgba32float' : 'rgba16float');
    this.#add = copyPipeline(device, copy, this.#sumFormat, { color: WEIGHED, alpha: WEIGHED });
    this.#show = copyPipeline(device, copy, format);
  }

  /**
   * The render target for the next picture.
   * @param {number} width
   * @param {number} height
   */
  part(width, height) {
    if (this.#part && this.#part.width === width && this.#part.height === height) return this.#part;
    this.dispose();
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.TEXTURE_BINDING;
    const part = this.#device.createTexture({ size: [width, height], format: this.partFormat, usage });
    this.#part = part;
    this.#sum = this.#device.createTexture({ size: [width, height], format: this.#sumFormat, usage });
    return part;
  }

  /**
   * Blends the picture into the mean with a weight.
   * @param {number} weight
   */
  add(weight) {
    if (this.#part && this.#sum) copyTexture(this.#device, this.#add, this.#part, this.#sum, weight);
  }

  /**
   * Writes the mean to a texture.
   * @param {GPUTexture} texture
   */
  show(texture) {
    if (this.#sum) copyTexture(this.#device, this.#show, this.#sum, texture);
  }

  dispose() {
    this.#part?.destroy();
    this.#sum?.destroy();
    this.#part = this.#sum = null;
  }
}

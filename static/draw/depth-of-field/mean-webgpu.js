// The running mean of pictures with WebGPU: each is drawn into `part`, and blended into a sum by its weight.
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
   * What the next picture is drawn into.
   * @type {GPUTexture | null}
   */
  #part = null;

  /**
   * @param {GPUDevice} device
   * @param {GPUShaderModule} copy of copy.wgsl
   * @param {GPUTextureFormat} partFormat of the pictures
   * @param {GPUTextureFormat} format of what shows their mean
   */
  constructor(device, copy, partFormat, format) {
    this.#device = device;
    this.partFormat = partFormat;
    // the last of many pictures change a sum of 16-bit floats by less than it can tell
    this.#sumFormat = /** @type {GPUTextureFormat} */ (device.features.has('float32-blendable') ? 'rgba32float' : 'rgba16float');
    this.#add = copyPipeline(device, copy, this.#sumFormat, { color: WEIGHED, alpha: WEIGHED });
    this.#show = copyPipeline(device, copy, format);
  }

  /**
   * What the next picture is to be drawn into.
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
   * Takes the part into the mean, of which it is the share `weight`.
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

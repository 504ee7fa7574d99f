// The running mean of pictures with WebGPU: each is drawn into `part`, and blended into a sum of half floats by its weight.

const SUM_FORMAT = 'rgba16float';
const VERTICES = 3;
const SHADER = `
@group(0) @binding(0) var picture: texture_2d<f32>;

@vertex
fn vs(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
    return vec4f(f32(i & 1u) * 4.0 - 1.0, f32(i >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}

@fragment
fn fs(@builtin(position) at: vec4f) -> @location(0) vec4f {
    return textureLoad(picture, vec2i(at.xy), 0);
}`;

export class WebGpuMean {
  #device;
  #add;
  #show;
  /** @type {GPUTexture | null} */
  #sum = null;
  /**
   * What the next picture is drawn into.
   * @type {GPUTexture | null}
   */
  part = null;

  /** @param {string} format of the pictures and of what shows their mean */
  constructor(device, format) {
    this.#device = device;
    this.format = format;
    const module = device.createShaderModule({ code: SHADER });
    const weighed = { srcFactor: 'constant', dstFactor: 'one-minus-constant', operation: 'add' };
    const pipeline = (target) =>
      device.createRenderPipeline({
        layout: 'auto',
        vertex: { module, entryPoint: 'vs' },
        fragment: { module, entryPoint: 'fs', targets: [target] },
        primitive: { topology: 'triangle-list' },
      });
    this.#add = pipeline({ format: SUM_FORMAT, blend: { color: weighed, alpha: weighed } });
    this.#show = pipeline({ format });
  }

  resize(width, height) {
    if (this.part?.width === width && this.part?.height === height) return;
    this.dispose();
    const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.TEXTURE_BINDING;
    this.part = this.#device.createTexture({ size: [width, height], format: this.format, usage });
    this.#sum = this.#device.createTexture({ size: [width, height], format: SUM_FORMAT, usage });
  }

  /** Takes `part` into the mean, of which it is the share `weight`. */
  add(weight) {
    this.#pass(this.#add, this.part, this.#sum, 'load', weight);
  }

  /** Writes the mean to a texture. */
  show(texture) {
    this.#pass(this.#show, this.#sum, texture, 'clear', 0);
  }

  #pass(pipeline, from, to, loadOp, weight) {
    const device = this.#device;
    const encoder = device.createCommandEncoder();
    const pass = encoder.beginRenderPass({
      colorAttachments: [{ view: to.createView(), loadOp, clearValue: [0, 0, 0, 0], storeOp: 'store' }],
    });
    pass.setPipeline(pipeline);
    pass.setBlendConstant([weight, weight, weight, weight]);
    pass.setBindGroup(
      0,
      device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries: [{ binding: 0, resource: from.createView() }] }),
    );
    pass.draw(VERTICES);
    pass.end();
    device.queue.submit([encoder.finish()]);
  }

  dispose() {
    this.part?.destroy();
    this.#sum?.destroy();
    this.part = this.#sum = null;
  }
}

// Copies textures with WebGPU and copy.wgsl, between formats or with blending.

/** Vertices of the triangle that covers the target. */
const VERTICES = 3;

/**
 * @param {GPUDevice} device
 * @param {GPUShaderModule} module of copy.wgsl
 * @param {GPUTextureFormat} format of the target
 * @param {GPUBlendState} [blend]
 */
export function copyPipeline(device, module, format, blend) {
  return device.createRenderPipeline({
    layout: 'auto',
    vertex: { module, entryPoint: 'vs' },
    fragment: { module, entryPoint: 'fs', targets: [{ format, ...(blend && { blend }) }] },
    primitive: { topology: 'triangle-list' },
  });
}

/**
 * @param {GPUDevice} device
 * @param {GPURenderPipeline} pipeline of `copyPipeline`
 * @param {GPUTexture} from
 * @param {GPUTexture} to of the same size; with `weight`, the blend constant, its content is kept and blended
 * @param {number} [weight]
 */
export function copyTexture(device, pipeline, from, to, weight) {
  const encoder = device.createCommandEncoder();
  const pass = encoder.beginRenderPass({
    colorAttachments: [
      { view: to.createView(), loadOp: weight === undefined ? 'clear' : 'load', clearValue: [0, 0, 0, 0], storeOp: 'store' },
    ],
  });
  pass.setPipeline(pipeline);
  if (weight !== undefined) pass.setBlendConstant([weight, weight, weight, weight]);
  pass.setBindGroup(
    0,
    device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries: [{ binding: 0, resource: from.createView() }] }),
  );
  pass.draw(VERTICES);
  pass.end();
  device.queue.submit([encoder.finish()]);
}

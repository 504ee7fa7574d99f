// The mean of many pictures includes the last ones.
import assert from 'node:assert/strict';
import { before, describe, test } from 'node:test';
import { openPage } from '../../support/browser.mjs';
import { boxSuite } from '../../support/suite.mjs';

/** Sorted levels are the hardest case: 16-bit floats would ignore the second half. */
const LEVELS = [...Array(32).fill(153), ...Array(32).fill(155)];

describe('mean of many pictures', () => {
  const suite = boxSuite();
  let page;
  let errors;
  before(async () => {
    ({ page, errors } = await openPage(suite.browser));
    await page.goto(`${suite.server.url}/embed/blank`);
  });

  test('is exact with WebGPU', async (t) => {
    const got = await page.evaluate(async (levels) => {
      const { acquireDevice } = await import('/static/draw/device.js');
      const { WebGpuMean } = await import('/static/draw/depth-of-field/mean-webgpu.js');
      const shared = await acquireDevice();
      const device = shared.handle;
      const code = await (await fetch('/static/draw/copy.wgsl')).text();
      const mean = new WebGpuMean(device, device.createShaderModule({ code }), 'rgba8unorm', 'rgba8unorm');
      levels.forEach((level, i) => {
        const encoder = device.createCommandEncoder();
        const clearValue = Array(4).fill(level / 255);
        encoder
          .beginRenderPass({ colorAttachments: [{ view: mean.part(4, 4).createView(), loadOp: 'clear', clearValue, storeOp: 'store' }] })
          .end();
        device.queue.submit([encoder.finish()]);
        mean.add(1 / (i + 1));
      });
      const usage = GPUTextureUsage.RENDER_ATTACHMENT | GPUTextureUsage.COPY_SRC;
      const texture = device.createTexture({ size: [4, 4], format: 'rgba8unorm', usage });
      mean.show(texture);
      const buffer = device.createBuffer({ size: 1024, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
      const encoder = device.createCommandEncoder();
      encoder.copyTextureToBuffer({ texture }, { buffer, bytesPerRow: 256 }, [4, 4]);
      device.queue.submit([encoder.finish()]);
      await buffer.mapAsync(GPUMapMode.READ);
      const level = new Uint8Array(buffer.getMappedRange())[5];
      const fine = device.features.has('float32-blendable');
      shared.release();
      return { level, fine };
    }, LEVELS);
    t.diagnostic(JSON.stringify(got));
    assert.ok(got.fine, 'the browser must blend 32-bit floats');
    assert.equal(got.level, 154);
    assert.deepEqual(errors, []);
  });

  test('is exact with WebGL2', async (t) => {
    const got = await page.evaluate(async (levels) => {
      const { WebGlMean } = await import('/static/draw/depth-of-field/mean-webgl.js');
      const { copier } = await import('/static/draw/webgl-copy.js');
      const canvas = document.createElement('canvas');
      canvas.width = canvas.height = 4;
      const gl = canvas.getContext('webgl2', { preserveDrawingBuffer: true });
      const { begin, built } = await import('/static/draw/webgl-program.js');
      const { COPY_VERTEX, COPY_FRAGMENT } = await import('/static/draw/glsl.js');
      const copy = copier(gl, await built(gl, begin(gl, COPY_VERTEX, COPY_FRAGMENT)));
      const mean = new WebGlMean(gl, copy, gl.RGBA8);
      levels.forEach((level, i) => {
        gl.bindFramebuffer(gl.FRAMEBUFFER, mean.part(4, 4));
        gl.clearColor(level / 255, level / 255, level / 255, 1);
        gl.clear(gl.COLOR_BUFFER_BIT);
        mean.add(1 / (i + 1));
      });
      mean.show();
      const pixel = new Uint8Array(4);
      gl.readPixels(1, 1, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
      return { level: pixel[0], fine: gl.getSupportedExtensions().includes('EXT_float_blend'), error: gl.getError() };
    }, LEVELS);
    t.diagnostic(JSON.stringify(got));
    assert.ok(got.fine, 'the browser must blend 32-bit floats');
    assert.deepEqual([got.level, got.error], [154, 0]);
    assert.deepEqual(errors, []);
  });
});

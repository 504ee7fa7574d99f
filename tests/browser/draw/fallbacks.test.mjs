// Fallbacks when a renderer fails.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { fractionDifferent, pixelsAt, waitForMode } from '../support/browser.mjs';
import { boxSuite, HEIGHT, WIDTH } from '../support/suite.mjs';

describe('fallbacks', () => {
  const suite = boxSuite();

  test('lost devices fall back to WebGL, then the server', async () => {
    const { page, context } = await suite.open();
    await waitForMode(page, 'gpu');
    const before = await pixelsAt(page, { tx: 0.02 }, WIDTH, HEIGHT);
    await page.evaluate(() => {
      window.lost = window.viewer.renderer;
      window.lost.device.destroy();
    });
    await page.waitForFunction(() => window.viewer.renderer && window.viewer.renderer !== window.lost);
    await waitForMode(page, 'gpu');
    const rebuilt = await pixelsAt(page, { tx: 0.02 }, WIDTH, HEIGHT);
    assert.equal(fractionDifferent(before, rebuilt, WIDTH, HEIGHT, { levels: 0 }), 0);
    await page.evaluate(() => window.viewer.renderer.device.destroy());
    await waitForMode(page, 'webgl');
    const other = fractionDifferent(before, await pixelsAt(page, { tx: 0.02 }, WIDTH, HEIGHT), WIDTH, HEIGHT);
    assert.ok(other < 0.005, `${other} of the pixels differ between WebGPU and WebGL2`);
    for (let i = 0; i < 2; i++) {
      await page.evaluate(() => {
        window.lost = window.viewer.renderer;
        window.lost.gl.getExtension('WEBGL_lose_context').loseContext();
      });
      await page.waitForFunction(() => window.viewer.renderer !== window.lost && window.viewer.mode !== 'loading');
    }
    await waitForMode(page, 'served');
    await page.waitForFunction(() => document.querySelector('.tmpi-poster').naturalWidth > 0);
    assert.equal(await page.locator('.tmpi-canvas').count(), 0);
    await context.close();
  });
});

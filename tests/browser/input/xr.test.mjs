// VR headsets.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { describe, test } from 'node:test';
import { openPage, waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

/** A small page, for fast software rendering. */
const SMALL = { viewport: { width: 480, height: 460 } };
const EMULATOR = createRequire(import.meta.url).resolve('iwer/build/iwer.min.js');

/** In the page: fraction of an eye's pixels that differ from the page's view at its pose, and fraction that is not black. */
function eyePicture() {
  const { headset } = window.viewer;
  return new Promise((resolve) => {
    // runs after the headset has drawn its frame, before it is shown
    headset.session.requestAnimationFrame(async () => {
      const { gl } = headset.renderer;
      const [{ pose, k, x, y, width, height }] = headset.views;
      const seen = new Uint8Array(width * height * 4);
      gl.bindFramebuffer(gl.FRAMEBUFFER, headset.layer.framebuffer);
      gl.readPixels(x, y, width, height, gl.RGBA, gl.UNSIGNED_BYTE, seen);
      const drawn = await headset.renderer.readPixels(pose, k, width, height);
      let [off, covered] = [0, 0];
      for (let row = 0; row < height; row++) {
        for (let i = 0; i < width * 4; i += 4) {
          // readPixels starts at the bottom row
          const [a, b] = [(height - 1 - row) * width * 4 + i, row * width * 4 + i];
          if ([0, 1, 2].some((c) => Math.abs(seen[a + c] - drawn[b + c]) > 8)) off++;
          if ([0, 1, 2].some((c) => seen[a + c] > 8)) covered++;
        }
      }
      resolve({ off: off / (width * height), covered: covered / (width * height) });
    });
  });
}

describe('headset', () => {
  const suite = boxSuite();

  test('a headset shows the photo within the view box', async () => {
    const { page, context, errors } = await openPage(suite.browser, SMALL);
    await page.addInitScript(`${readFileSync(EMULATOR, 'utf8')}
      window.headset = new IWER.XRDevice(IWER.metaQuest3);
      window.headset.installRuntime({ forceInstall: true });`);
    await page.goto(`${suite.server.url}/view/box`);
    await waitForMode(page, 'gpu');
    await page.locator('#show').click();
    await page.getByRole('button', { name: 'Look around in a headset' }).click();
    await page.waitForFunction(() => window.viewer.headset?.frames > 2);
    const poses = () => page.evaluate(() => window.viewer.headset.views.map(({ pose }) => pose));
    const eyes = await poses();
    assert.equal(eyes.length, 2);
    assert.ok(Math.abs(eyes[1].tx - eyes[0].tx - 1 / 30) < 2e-3, JSON.stringify(eyes));
    // far right and up, turned left
    await page.evaluate(() => {
      window.headset.position.set(window.headset.position.x + 5, window.headset.position.y + 5, window.headset.position.z);
      window.headset.quaternion.set(0, Math.sin(0.15), 0, Math.cos(0.15));
    });
    await page.waitForFunction(() => window.viewer.headset.views[0].pose.yaw < -5);
    const [left, right] = await poses();
    assert.ok((left.tx + right.tx) / 2 > 0.025 && (left.tx + right.tx) / 2 <= 0.0301, JSON.stringify([left, right]));
    assert.ok(left.ty < -0.025 && left.ty >= -0.0301, 'up moves the camera up');
    assert.ok(Math.abs(left.yaw + (0.3 * 180) / Math.PI) < 0.5, `turned to the left: ${left.yaw}`);
    assert.ok(await page.evaluate(() => window.viewer.asleep));
    const { off, covered } = await page.evaluate(eyePicture);
    assert.ok(off < 0.01 && covered > 0.3, `${off} of the eye's pixels differ from the page's view; ${covered} of them are not background`);
    await page.evaluate(() => window.viewer.headset.end());
    await page.waitForFunction(() => !window.viewer.headset && !window.viewer.asleep);
    assert.deepEqual(errors, []);
    await context.close();
  });
});

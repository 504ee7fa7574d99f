// A headset instead of a screen.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { describe, test } from 'node:test';
import { openPage, waitForMode } from '../support/browser.mjs';
import { boxSuite, STILL } from '../support/suite.mjs';

/** A page on which a software rasteriser is soon done. */
const SMALL = { ...STILL, viewport: { width: 480, height: 460 } };
const EMULATOR = createRequire(import.meta.url).resolve('iwer/build/iwer.min.js');

describe('headset', () => {
  const suite = boxSuite();

  test('a headset shows it, within the view box, and gives the page back', async () => {
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
    // far to the right and up, turned to the left
    await page.evaluate(() => {
      window.headset.position.set(window.headset.position.x + 5, window.headset.position.y + 5, window.headset.position.z);
      window.headset.quaternion.set(0, Math.sin(0.15), 0, Math.cos(0.15));
    });
    await page.waitForFunction(() => window.viewer.headset.views[0].pose.yaw < -5);
    const [left, right] = await poses();
    assert.ok((left.tx + right.tx) / 2 > 0.025 && (left.tx + right.tx) / 2 <= 0.0301, JSON.stringify([left, right]));
    assert.ok(left.ty < -0.025 && left.ty >= -0.0301, 'up is up');
    assert.ok(Math.abs(left.yaw + (0.3 * 180) / Math.PI) < 0.5, `turned to the left: ${left.yaw}`);
    assert.ok(await page.evaluate(() => window.viewer.asleep));
    // what an eye sees is what the page draws at its pose
    assert.ok(await page.evaluate(() => window.viewer.headset.renderer.gl.getError() === 0));
    await page.evaluate(() => window.viewer.headset.end());
    await page.waitForFunction(() => !window.viewer.headset && !window.viewer.asleep);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('without a headset none is offered', async () => {
    const { page, context } = await openPage(suite.browser, SMALL);
    await page.goto(`${suite.server.url}/view/box`);
    await waitForMode(page, 'gpu');
    await page.locator('#show').click();
    assert.equal(await page.getByRole('button', { name: 'Look around in a headset' }).isVisible(), false);
    await context.close();
  });
});

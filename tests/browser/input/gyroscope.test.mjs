// Tilting the device moves the camera.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';
import { waitForAnimationFrames, waitForStill } from '../support/until.mjs';

describe('gyroscope', () => {
  const suite = boxSuite();

  test('tilt moves the camera until the box is unchecked', async () => {
    const { page, context, errors } = await openPage(suite.browser, { hasTouch: true });
    await page.goto(`${suite.server.url}/view/box`);
    await waitForMode(page, 'gpu');
    await page.locator('#show').click();
    const box = page.getByLabel('Move by tilting');
    await box.check();
    const tilt = (beta, gamma) =>
      page.evaluate(([b, g]) => dispatchEvent(new DeviceOrientationEvent('deviceorientation', { beta: b, gamma: g })), [beta, gamma]);
    const settled = async () => {
      // an event takes effect in the next frame
      await waitForAnimationFrames(page, 3);
      await waitForStill(page);
    };
    const pose = () => page.evaluate(() => window.viewer.pose);
    // wait for the permission request
    await page.waitForFunction(() => window.viewer.tilting);
    await tilt(40, 10);
    await settled();
    assert.ok(Math.abs((await pose()).tx) < 1e-4, 'the first orientation is the centre');
    await tilt(40, 20);
    await page.waitForFunction(() => window.viewer.pose.tx > 0.01);
    await tilt(30, 10);
    await page.waitForFunction(() => window.viewer.pose.ty < -0.01);
    await settled();
    const last = await pose();
    const stage = await page.locator('#stage').boundingBox();
    await page.mouse.move(stage.x + 20, stage.y + 20);
    await page.mouse.move(stage.x + 60, stage.y + 40);
    await settled();
    assert.deepEqual(await pose(), last, 'hovering does not override the tilt');
    await box.uncheck();
    await tilt(70, 60);
    await settled();
    assert.deepEqual(await pose(), last);
    assert.deepEqual(errors, []);
    await context.close();
  });
});

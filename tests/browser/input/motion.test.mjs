// Keys, drags, the wheel, and what moves by itself.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

describe('motion', () => {
  const suite = boxSuite();

  test('keys, drag, wheel and buttons move the camera, within the view box', async () => {
    const { page, context, errors } = await suite.open();
    await waitForMode(page, 'gpu');
    // input reaches the page some time after it is sent: wait for what it has to lead to
    const comesTo = async (what, key, least, most) => {
      const there = ([k, from, to]) => !window.viewer.moving && window.viewer.pose[k] >= from && window.viewer.pose[k] <= to;
      await page.waitForFunction(there, [key, least, most], { timeout: 10_000 }).catch(async () => {
        assert.fail(`${what}: ${JSON.stringify(await page.evaluate(() => window.viewer.pose))}`);
      });
    };
    await page.locator('#stage').focus();
    for (let i = 0; i < 3; i++) await page.keyboard.press('ArrowRight');
    await comesTo('three steps to the right', 'tx', 0.01, 0.027);
    for (let i = 0; i < 30; i++) await page.keyboard.press('ArrowRight');
    await comesTo('the limit', 'tx', 0.027, 0.03);
    await page.keyboard.press('0');
    await comesTo('back', 'tx', 0, 0);
    await page.keyboard.press('+');
    await comesTo('closer', 'tz', 0.003, 0.03);
    await page.keyboard.press('Home');
    await comesTo('back', 'tz', 0, 0);
    const box = await page.locator('#stage').boundingBox();
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    await page.mouse.down();
    await page.mouse.move(box.x + box.width / 2 + 150, box.y + box.height / 2, { steps: 5 });
    await page.mouse.up();
    await comesTo('near things follow the pointer', 'tx', -0.03, -0.005);
    await page.locator('#reset').click();
    await comesTo('reset', 'tx', -1e-4, 1e-4);
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    await page.mouse.wheel(0, -200);
    await comesTo('the wheel', 'tz', 0.003, 0.03);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('moves by itself, but not for those who asked for less motion', async () => {
    const moved = async (options) => {
      const { page, context } = await suite.open(options);
      await waitForMode(page, 'gpu');
      const pressed = await page.locator('#idle').getAttribute('aria-pressed');
      await page.waitForTimeout(2500);
      const pose = await page.evaluate(() => window.viewer.pose);
      await page.locator('#stage').focus();
      await page.keyboard.press(' ');
      const toggled = await page.locator('#idle').getAttribute('aria-pressed');
      await context.close();
      return { pressed, toggled, far: Math.abs(pose.tx) + Math.abs(pose.ty) };
    };
    const usual = await moved({});
    assert.ok(usual.far > 1e-4, `${usual.far}`);
    assert.deepEqual([usual.pressed, usual.toggled], ['true', 'false']);
    const calm = await moved({ reducedMotion: 'reduce' });
    assert.equal(calm.far, 0);
    assert.deepEqual([calm.pressed, calm.toggled], ['false', 'true']);
  });
});

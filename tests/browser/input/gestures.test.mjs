// Pointer, wheel and fingers.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, waitForMode } from '../support/browser.mjs';
import { boxSuite, STILL } from '../support/suite.mjs';

const SMALL = { ...STILL, viewport: { width: 500, height: 480 } };
const zoom = (page) => page.evaluate(() => window.viewer.zoom);
/** Waits until nothing moves and the zoom is as wanted. */
const zoomed = (page, least, most) =>
  page.waitForFunction(
    ([from, to]) => !window.viewer.moving && window.viewer.zoom.scale >= from && window.viewer.zoom.scale <= to,
    [least, most],
  );

describe('gestures', () => {
  const suite = boxSuite();

  test('wheel, keys and two clicks come closer, about the pointer, and the camera stays where it is', async () => {
    const { page, context, errors } = await suite.open(SMALL);
    await waitForMode(page, 'gpu');
    const box = await page.locator('#stage').boundingBox();
    const middle = [box.x + box.width / 2, box.y + box.height / 2];
    await page.mouse.move(...middle);
    await page.mouse.wheel(0, -200);
    await zoomed(page, 1.5, 2);
    assert.equal(await page.evaluate(() => window.viewer.pose.tz), 0, 'it is no step forward');
    // a drag moves the photo now
    const before = await zoom(page);
    await page.mouse.down();
    await page.mouse.move(middle[0] + 60, middle[1], { steps: 4 });
    await page.mouse.up();
    assert.ok((await zoom(page)).x < before.x - 0.02);
    await page.locator('#stage').focus();
    await page.keyboard.press('0');
    await zoomed(page, 1, 1);
    await page.keyboard.press('+');
    await zoomed(page, 1.2, 1.3);
    await page.keyboard.press('-');
    await zoomed(page, 1, 1);
    await page.mouse.dblclick(middle[0] - 80, middle[1]);
    await zoomed(page, 2, 10);
    assert.ok((await zoom(page)).x < 0.5, 'about the pointer');
    await page.waitForTimeout(400);
    await page.mouse.dblclick(...middle);
    await zoomed(page, 1, 1);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('two fingers come closer, and one moves the photo then', async () => {
    const { page, context, errors } = await openPage(suite.browser, { ...SMALL, hasTouch: true });
    await page.goto(`${suite.server.url}/view/box`);
    await waitForMode(page, 'gpu');
    const { x, y, width, height } = await page.locator('#stage').boundingBox();
    const [cx, cy] = [x + width / 2, y + height / 2];
    const client = await context.newCDPSession(page);
    const touch = (type, ...points) =>
      client.send('Input.dispatchTouchEvent', { type, touchPoints: points.map(([px, py], id) => ({ x: px, y: py, id })) });
    await touch('touchStart', [cx - 40, cy], [cx + 40, cy]);
    for (let i = 1; i <= 6; i++) await touch('touchMove', [cx - 40 - i * 8, cy], [cx + 40 + i * 8, cy]);
    await touch('touchEnd');
    await page.waitForFunction(() => window.viewer.zoom.scale > 1.8);
    const before = await zoom(page);
    await touch('touchStart', [cx, cy]);
    for (let i = 1; i <= 4; i++) await touch('touchMove', [cx - i * 12, cy]);
    await touch('touchEnd');
    assert.ok((await zoom(page)).x > before.x + 0.02);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('after a drag hovering goes on from there', async () => {
    const { page, context } = await suite.open(SMALL);
    await waitForMode(page, 'gpu');
    const box = await page.locator('#stage').boundingBox();
    const [cx, cy] = [box.x + box.width / 2, box.y + box.height / 2];
    const settled = async () => {
      await page.waitForFunction(() => !window.viewer.moving);
      return page.evaluate(() => window.viewer.pose.tx);
    };
    await page.mouse.move(cx, cy);
    await page.mouse.down();
    await page.mouse.move(cx + 40, cy, { steps: 4 });
    await page.mouse.up();
    const put = await settled();
    assert.ok(put < -0.003, `${put}`);
    await page.mouse.move(cx + 41, cy);
    assert.ok(Math.abs((await settled()) - put) < 0.004, 'no jump');
    await page.mouse.move(cx + 100, cy, { steps: 10 });
    const right = await settled();
    await page.mouse.move(cx - 150, cy, { steps: 20 });
    assert.ok((await settled()) > right + 0.005, 'it follows the pointer');
    await context.close();
  });

  test('an element leaves the wheel to the page until it is asked', async () => {
    const { page, context } = await openPage(suite.browser, { ...SMALL, viewport: { width: 500, height: 300 } });
    await page.goto(`${suite.server.url}/embed/three`);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').loaded);
    const scale = () => page.evaluate(() => document.querySelector('tmpi-viewer').viewer.zoom.scale);
    const { x, y } = await page.locator('tmpi-viewer').first().boundingBox();
    await page.mouse.move(x + 60, y + 60);
    await page.mouse.wheel(0, 40);
    await page.waitForFunction(() => scrollY > 20);
    assert.equal(await scale(), 1);
    await page.evaluate(() => scrollTo(0, 0));
    await page.keyboard.down('Control');
    await page.mouse.wheel(0, -60);
    await page.keyboard.up('Control');
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer.zoom.scale > 1.3);
    assert.equal(await page.evaluate(() => scrollY), 0);
    await context.close();
  });
});

// Pointer, wheel and touch.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';
import { waitForStill } from '../support/until.mjs';

/** A small page, because each step of a gesture waits for a frame. */
const SMALL = { viewport: { width: 400, height: 400 } };
const zoom = (page) => page.evaluate(() => window.viewer.zoom);
/** Waits until nothing moves and the zoom is in a range. */
const waitForZoom = (page, least, most) =>
  waitForStill(page, { when: ({ zoom }, [from, to]) => zoom.scale >= from && zoom.scale <= to, given: [least, most] });

/** Touch input: `touch` sends an event, `drag` moves all fingers by an offset. */
async function touchInput(page) {
  const client = await page.context().newCDPSession(page);
  const touch = (type, ...points) =>
    client.send('Input.dispatchTouchEvent', { type, touchPoints: points.map(([x, y], id) => ({ x, y, id })) });
  const drag = async ([dx, dy], ...from) => {
    await touch('touchStart', ...from);
    for (let i = 1; i <= 8; i++) await touch('touchMove', ...from.map(([x, y]) => [x + (dx * i) / 8, y + (dy * i) / 8]));
    await touch('touchEnd');
  };
  return { touch, drag };
}

describe('gestures', () => {
  const suite = boxSuite();

  test('wheel, keys and double click zoom without moving the camera', async () => {
    const { page, context, errors } = await suite.open(SMALL);
    await waitForMode(page, 'gpu');
    const box = await page.locator('#stage').boundingBox();
    const middle = [box.x + box.width / 2, box.y + box.height / 2];
    await page.mouse.move(...middle);
    await page.mouse.wheel(0, -200);
    await waitForZoom(page, 1.5, 2);
    assert.equal(await page.evaluate(() => window.viewer.pose.tz), 0, 'the camera does not step forward');
    // when zoomed, a drag pans the photo
    const before = await zoom(page);
    await page.mouse.down();
    await page.mouse.move(middle[0] + 60, middle[1], { steps: 4 });
    await page.mouse.up();
    assert.ok((await zoom(page)).x < before.x - 0.02);
    await page.locator('#stage').focus();
    await page.keyboard.press('0');
    await waitForZoom(page, 1, 1);
    await page.keyboard.press('+');
    await waitForZoom(page, 1.2, 1.3);
    await page.keyboard.press('-');
    await waitForZoom(page, 1, 1);
    await page.mouse.dblclick(middle[0] - 80, middle[1]);
    await waitForZoom(page, 2, 10);
    assert.ok((await zoom(page)).x < 0.5, 'the zoom centres on the pointer');
    await page.mouse.dblclick(...middle);
    await waitForZoom(page, 1, 1);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('two fingers zoom, then one finger pans', async () => {
    const { page, context, errors } = await openPage(suite.browser, { ...SMALL, hasTouch: true });
    await page.goto(`${suite.server.url}/view/box`);
    await waitForMode(page, 'gpu');
    const { x, y, width, height } = await page.locator('#stage').boundingBox();
    const [cx, cy] = [x + width / 2, y + height / 2];
    const { touch } = await touchInput(page);
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

  test('hovering continues from where a drag ended', async () => {
    const { page, context } = await suite.open(SMALL);
    await waitForMode(page, 'gpu');
    const box = await page.locator('#stage').boundingBox();
    const [cx, cy] = [box.x + box.width / 2, box.y + box.height / 2];
    const settled = async () => {
      await waitForStill(page);
      return page.evaluate(() => window.viewer.pose.tx);
    };
    await page.mouse.move(cx, cy);
    await page.mouse.down();
    await page.mouse.move(cx + 40, cy, { steps: 4 });
    await page.mouse.up();
    const dragged = await settled();
    assert.ok(dragged < -0.003, `${dragged}`);
    await page.mouse.move(cx + 41, cy);
    assert.ok(Math.abs((await settled()) - dragged) < 0.004, 'no jump');
    await page.mouse.move(cx + 100, cy, { steps: 4 });
    const right = await settled();
    await page.mouse.move(cx - 150, cy, { steps: 6 });
    assert.ok((await settled()) > right + 0.005, 'the camera follows the pointer');
    await context.close();
  });

  test('an element zooms only with Ctrl and the wheel', async () => {
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

  test('vertical swipes scroll the page; other touches move the camera', async () => {
    const { page, context, errors } = await openPage(suite.browser, { ...SMALL, viewport: { width: 400, height: 300 }, hasTouch: true });
    await page.goto(`${suite.server.url}/embed/three`);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').loaded);
    await page.evaluate(() => document.querySelector('tmpi-viewer').viewer.setIdle(false));
    const { touch, drag } = await touchInput(page);
    const raw = () => page.evaluate(() => ({ ...document.querySelector('tmpi-viewer').viewer.motion.raw }));
    const assertScrolls = async (what) => {
      const before = await raw();
      await drag([6, -100], [150, 130]);
      await page.waitForFunction(() => scrollY > 40, null, { timeout: 5000 }).catch(() => assert.fail(`${what}: the page does not scroll`));
      assert.deepEqual(await raw(), before, `${what}: the camera stays`);
      // momentum scrolling has stopped after ten still checks, 20 ms apart
      await page.evaluate(() => Object.assign(window, { lastY: -1, still: 0 }));
      await page.waitForFunction(() => {
        window.still = window.lastY === scrollY ? window.still + 1 : 0;
        window.lastY = scrollY;
        return window.still > 10;
      });
      await page.evaluate(() => scrollTo(0, 0));
    };
    await assertScrolls('whole photo');
    await drag([-60, 4], [150, 100]);
    const sideways = await raw();
    assert.ok(sideways.x > 0.4 && Math.abs(sideways.y) < 0.1, JSON.stringify(sideways));
    await drag([0, -60], [110, 130], [160, 130]);
    const both = await raw();
    assert.ok(both.y > sideways.y + 0.4, `two fingers move the camera: ${both.y}`);
    assert.equal(await page.evaluate(() => scrollY), 0);
    // zoom in, and back out
    for (const close of [true, false]) {
      // far from the last taps, else the browser counts triple taps; without a wait, else a busy machine taps too slowly
      const place = [close ? 120 : 200, 100];
      await Promise.all([touch('touchStart', place), touch('touchEnd'), touch('touchStart', place), touch('touchEnd')]);
      const isReached = ({ zoom }, wanted) => zoom.scale > 1.5 === wanted;
      await waitForStill(page, { viewer: "document.querySelector('tmpi-viewer').viewer", when: isReached, given: close });
      await assertScrolls(close ? 'zoomed in' : 'zoomed out');
    }
    assert.deepEqual(
      errors.filter((e) => !e.includes('favicon')),
      [],
    );
    await context.close();
  });

  test('in full screen all touches and the wheel apply', async () => {
    const { page, context } = await openPage(suite.browser, { ...SMALL, hasTouch: true });
    await page.goto(`${suite.server.url}/embed/three`);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').loaded);
    await page.locator('tmpi-viewer').first().getByRole('button', { name: 'Full screen' }).focus();
    await page.keyboard.press('Enter');
    await page.waitForFunction(() => document.fullscreenElement?.localName === 'tmpi-viewer');
    const { drag } = await touchInput(page);
    const [x, y] = await page.evaluate(() => [innerWidth / 2, innerHeight / 2]);
    await drag([2, -80], [x, y]);
    const raw = await page.evaluate(() => document.fullscreenElement.viewer.motion.raw.y);
    assert.ok(raw > 0.2, `${raw}`);
    await page.mouse.move(x, y);
    await page.mouse.wheel(0, -200);
    await page.waitForFunction(() => document.fullscreenElement.viewer.zoom.scale > 1.3);
    await context.close();
  });
});

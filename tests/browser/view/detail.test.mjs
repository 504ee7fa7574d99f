// Finer parts of large photos.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { partAddress, wantedPart } from '../../../static/view/detail.js';
import { openPage, takeGraphics, waitForMode } from '../support/browser.mjs';
import { boxContainer } from '../support/container.mjs';
import { boxSuite, STILL } from '../support/suite.mjs';

const PHOTO = { width: 6000, height: 4000 };
const LOADED = { width: 1500 };
const SCREEN = { width: 1200, height: 800 };

describe('the part that is wanted', () => {
  test('none as long as the level at hand is as fine as the screen, or the photo has no more', () => {
    assert.equal(wantedPart(PHOTO, LOADED, { scale: 1.4, x: 0.5, y: 0.5 }, SCREEN), null);
    assert.equal(wantedPart(PHOTO, PHOTO, { scale: 10, x: 0.5, y: 0.5 }, SCREEN), null);
  });

  test('covers what is in sight, with a margin, at the level that the screen shows', () => {
    for (const [scale, level] of [
      [2.4, 1],
      [5, 0],
      [10, 0],
    ]) {
      for (const [x, y] of [
        [0.5, 0.5],
        [0.1, 0.95],
      ]) {
        const part = wantedPart(PHOTO, LOADED, { scale, x, y }, SCREEN);
        assert.equal(part.level, level, `${scale}`);
        const { rect } = part;
        const half = { x: PHOTO.width / scale / 2, y: (PHOTO.width / scale / 2) * (SCREEN.height / SCREEN.width) };
        const least = [x * PHOTO.width - half.x, y * PHOTO.height - half.y].map((v) => Math.max(0, v));
        const most = [Math.min(PHOTO.width, x * PHOTO.width + half.x), Math.min(PHOTO.height, y * PHOTO.height + half.y)];
        assert.ok(rect.x <= least[0] && rect.y <= least[1], JSON.stringify(part));
        assert.ok(rect.x + rect.w >= most[0] && rect.y + rect.h >= most[1], JSON.stringify(part));
        assert.ok(rect.x + rect.w <= PHOTO.width && rect.y + rect.h <= PHOTO.height && Number.isInteger(rect.x) && rect.w > 0);
        assert.ok((rect.w * rect.h) / 4 ** level < 12e6);
      }
    }
  });

  test('its address is beside the container’s', () => {
    const part = { level: 0, rect: { x: 512, y: 0, w: 900, h: 800 } };
    assert.equal(partAddress('/v1/photos/a/atlas?fit=1500&v=7', part), '/v1/photos/a/atlas?v=7&level=0&region=512,0,900,800');
    assert.equal(partAddress('data:application/vnd.tmpi;base64,AAAA', part), null);
  });
});

describe('finer parts', () => {
  const suite = boxSuite();

  for (const mode of ['gpu', 'webgl']) {
    test(`${mode}: one who comes close sees the photo’s own pixels, drawn over the level at hand`, async () => {
      const { page, context, errors } = await openPage(suite.browser, { ...STILL, viewport: { width: 500, height: 420 } });
      if (mode === 'webgl') await takeGraphics(page, { webgl: true });
      // the page has half of the photo's size
      Object.assign(suite.server.state, { width: 400, height: 240 });
      const parts = [];
      await page.route(/region=/, (route) => {
        parts.push(new URL(route.request().url()).search);
        route.fulfill({ contentType: 'application/vnd.tmpi', body: boxContainer(400, 240) });
      });
      await page.goto(`${suite.server.url}/view/box`);
      await waitForMode(page, mode);
      assert.equal(await page.locator('.tmpi-canvas').count(), 1);
      await page.evaluate(() => window.viewer.zoomBy(1.5));
      await page.waitForFunction(() => document.querySelectorAll('.tmpi-canvas').length === 2);
      assert.ok(parts.length >= 1 && parts.every((search) => search.includes('level=0')), parts.join(' '));
      const boxes = await page
        .locator('.tmpi-canvas')
        .evaluateAll((all) => all.map((c) => [c.width, c.height, c.clientWidth, c.clientHeight]));
      assert.deepEqual(boxes[0], boxes[1]);
      await page.locator('#reset').click();
      await page.waitForFunction(() => document.querySelectorAll('.tmpi-canvas').length === 1);
      assert.deepEqual(errors, []);
      await context.close();
    });
  }

  test('a part that cannot be had is not asked for again', async () => {
    const { page, context } = await openPage(suite.browser, { ...STILL, viewport: { width: 500, height: 420 } });
    Object.assign(suite.server.state, { width: 400, height: 240 });
    let asked = 0;
    await page.route(/region=/, (route) => {
      asked++;
      route.fulfill({ status: 500, body: 'no' });
    });
    await page.goto(`${suite.server.url}/view/box`);
    await waitForMode(page, 'gpu');
    await page.evaluate(() => window.viewer.zoomBy(1.5));
    await page.waitForTimeout(1500);
    await page.evaluate(() => window.viewer.zoomBy(1.2));
    await page.waitForTimeout(1000);
    assert.equal(asked, 1);
    assert.equal(await page.locator('.tmpi-canvas').count(), 1);
    await context.close();
  });
});

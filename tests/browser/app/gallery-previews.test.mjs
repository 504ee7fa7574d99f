// Moving previews on the gallery page: a sample if there is no photo, and one card at a time.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { MOTION, openPage } from '../support/browser.mjs';
import { boxPhoto } from '../support/pictures.mjs';
import { boxSuite } from '../support/suite.mjs';

describe('previews in the gallery', () => {
  const suite = boxSuite();
  const listed = (id) => ({
    id,
    state: 'done',
    created: '2026-03-04T05:06:07Z',
    width: 200,
    height: 120,
    atlas_bytes: 1500,
    links: { atlas: '/v1/photos/box/atlas?v=1', poster: '/v1/photos/box/thumbnail' },
  });

  async function open(photos, options = MOTION) {
    const opened = await openPage(suite.browser, { viewport: { width: 1280, height: 800 }, ...options });
    const requests = [];
    await opened.page.route('**/v1/photos', (route) => route.fulfill({ json: { photos } }));
    await opened.page.route('**/thumbnail', (route) => route.fulfill({ contentType: 'image/png', body: boxPhoto(60, 36) }));
    opened.page.on('request', (request) => /\/atlas|\.tmpi/.test(request.url()) && requests.push(new URL(request.url())));
    await opened.page.goto(`${suite.server.url}/`);
    return { ...opened, requests };
  }
  const moves = (page, selector) =>
    page.waitForFunction((s) => Math.abs(document.querySelector(s)?.viewer?.pose?.tx ?? 0) > 0.005, selector);

  test('shows a moving sample until there is a photo', async () => {
    const { page, context, errors, requests } = await open([]);
    await moves(page, '#sample tmpi-viewer');
    assert.deepEqual(
      requests.map(({ pathname }) => pathname),
      ['/static/sample/sample.tmpi'],
    );
    await page.route('**/v1/photos', (route) => route.fulfill({ json: { photos: [listed('a')] } }));
    await page.evaluate(() => import('/static/app/gallery.js').then((m) => m.refreshSoon()));
    await page.locator('.card').waitFor();
    assert.ok(await page.locator('#sample').isHidden());
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('only the card under the pointer moves', async () => {
    const { page, context, errors, requests } = await open(Array.from({ length: 100 }, (_, i) => listed(`p${i}`)));
    await moves(page, '.card:first-child tmpi-viewer');
    assert.equal(requests.length, 1);
    assert.equal(requests[0].search, '?v=1&fit=480');
    const card = page.locator('.card').nth(2);
    const { x, y, width } = await card.boundingBox();
    await page.mouse.move(x + 0.5 * width, y + 40);
    await page.waitForFunction(() => document.querySelector('.card:nth-child(3) tmpi-viewer.on'));
    await page.mouse.move(x + 0.95 * width, y + 40, { steps: 4 });
    // the camera moves left, so near things move right with the pointer
    await page.waitForFunction(() => document.querySelector('.card:nth-child(3) tmpi-viewer').viewer.pose.tx < -0.01);
    assert.equal(await page.locator('.card tmpi-viewer').count(), 1);
    assert.equal(requests.length, 2);
    await page.mouse.click(x + 0.5 * width, y + 40);
    await page.waitForURL('**/view/p2');
    assert.deepEqual(
      errors.filter((e) => !/p2/.test(e)),
      [],
    );
    await context.close();
  });

  test('cards do not move with reduced motion', async () => {
    const calm = await open([listed('a'), listed('b')], {});
    await calm.page.locator('.card').first().hover();
    // by the time another page moves, this one would have moved too
    const other = await open([listed('a')]);
    await moves(other.page, '.card tmpi-viewer');
    assert.deepEqual(calm.requests, []);
    for (const { context } of [calm, other]) await context.close();
  });
});

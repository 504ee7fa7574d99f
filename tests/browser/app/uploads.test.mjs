// Many uploads at once: the page shows the active ones, counts the others, and keeps the gallery in reach.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { seriousViolations } from '../support/browser.mjs';
import { boxPhoto } from '../support/pictures.mjs';
import { gate, until } from '../support/until.mjs';
import { photo, uploadSuite } from '../support/upload-page.mjs';

const COUNT = 40;

describe('many uploads', () => {
  const suite = uploadSuite();

  /** Opens the page with `count` uploads in progress; `finish(n)` completes the first n photos. */
  async function open(count, options = {}) {
    const ids = Array.from({ length: count }, (_, i) => `p${i}`);
    const { page, context, sent } = await suite.open({
      posts: ids.map((id) => ({ status: 202, json: { ...photo(id), state: 'queued' } })),
      pages: [{ photos: [photo('old')] }],
      options,
    });
    let made = 0;
    const ready = ids.map(gate);
    const finish = (n) => {
      made = n;
      for (const { open } of ready.slice(0, n)) open();
    };
    const events = 'event: stage\ndata: {"stage":"layers","step":3,"steps":4}\n\n';
    let most = 0;
    const followed = new Set();
    await page.route('**/v1/photos/*/events', async (route) => {
      const id = route
        .request()
        .url()
        .match(/photos\/([^/]+)/)[1];
      followed.add(id);
      most = Math.max(most, [...followed].filter((f) => Number(f.slice(1)) >= made).length);
      await ready[Number(id.slice(1))].opened;
      await route.fulfill({ contentType: 'text/event-stream', body: `${events}event: done\ndata: {}\n\n` }).catch(() => {});
    });
    const buffer = boxPhoto(30, 20);
    await page.setInputFiles(
      '#picker',
      ids.map((_, i) => ({ name: `photo ${i}.png`, mimeType: 'image/png', buffer })),
    );
    return { page, context, sent, finish, most: () => most };
  }
  const names = (page) => page.locator('.upload:visible .upload-name').allTextContents();

  test('shows active uploads, counts all, and hides finished ones', async () => {
    const { page, context, sent, finish, most } = await open(COUNT);
    await page.clock.install();
    await page.getByText(`0 of ${COUNT} ready`).waitFor();
    assert.deepEqual(await names(page), ['photo 0.png', 'photo 1.png', 'photo 2.png']);
    assert.equal(await page.locator('#uploads-more-text').textContent(), `and ${COUNT - 3} more`);
    const top = (await page.locator('#gallery .card').first().boundingBox()).y;
    assert.ok(top < 1100, `the gallery starts at ${top}`);
    await until(() => sent.length === COUNT);
    finish(12);
    await page.getByText(`12 of ${COUNT} ready`).waitFor();
    // the newest finished upload, and three active ones
    assert.deepEqual(await names(page), ['photo 11.png', 'photo 12.png', 'photo 13.png', 'photo 14.png']);
    assert.match(await page.title(), /^12 of 40/);
    const share = await page.locator('#uploads-bar').evaluate((bar) => bar.value);
    assert.ok(share > 12 / COUNT && share < 0.6, `${share}`);
    assert.ok(most() <= 4, `events take ${most()} connections`);
    assert.deepEqual(await seriousViolations(page), []);
    finish(COUNT);
    await page.getByText(`${COUNT} of ${COUNT} ready`).waitFor();
    assert.deepEqual(await names(page), [`photo ${COUNT - 1}.png`]);
    assert.equal(await page.title(), 'tmpi – 3D photos');
    // the last one stays a while
    assert.ok(await page.locator('#uploads').isVisible());
    await page.clock.fastForward(20_000);
    await page.locator('#uploads').waitFor({ state: 'hidden' });
    await context.close();
  });

  test('all can be cancelled at once', async () => {
    const { page, context, sent } = await open(8);
    await page.getByText('0 of 8 ready').waitFor();
    await until(() => sent.length === 8);
    await page.getByRole('button', { name: 'Cancel all' }).click();
    await page.locator('#uploads').waitFor({ state: 'hidden' });
    assert.deepEqual(
      suite.server.deleted.toSorted(),
      Array.from({ length: 8 }, (_, i) => `/v1/photos/p${i}`),
      'all photos are deleted',
    );
    await context.close();
  });

  test('fits a phone', async () => {
    const { page, context } = await open(8, { viewport: { width: 390, height: 844 } });
    await page.getByText('0 of 8 ready').waitFor();
    assert.deepEqual(await names(page), ['photo 0.png', 'photo 1.png', 'photo 2.png']);
    assert.equal(await page.locator('#uploads-more-text').textContent(), 'and 5 more');
    const { y, height } = await page.locator('#uploads').boundingBox();
    assert.ok(height < 500, `${y} ${height}`);
    await context.close();
  });
});

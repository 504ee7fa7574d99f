// Rooms in browsers that can draw nothing: plain video at the camera's own place, views that the server draws away from it.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { imagePixels, takeGraphics, waitForMode } from '../support/browser.mjs';
import { likenessOf, roomSuite, SAME_DB, shoot, showsFrames } from '../support/room.mjs';
import { until } from '../support/until.mjs';
import { HEIGHT, WIDTH } from '../support/video.mjs';

/** Pixels of the view that the server has drawn, as it is shown. */
function servedPixels(page) {
  // one that has just been put in place cannot be copied yet
  return until(() => imagePixels(page, '.tmpi-poster', WIDTH, HEIGHT).catch(() => null));
}
const seen = (page) => page.evaluate(() => getComputedStyle(window.viewer.canvas).visibility);
const blind = (page) => takeGraphics(page, { webgl: false });
/** A room whose frames need a decoder that this browser has not. */
const undecoded = async (page) => {
  await blind(page);
  await page.addInitScript(() => {
    // the worker is without one, too
    const { Worker: Plain } = window;
    window.Worker = class extends Plain {
      constructor(url) {
        const script = `delete self.VideoDecoder; const early = []; self.onmessage = (event) => early.push(event);
          await import(${JSON.stringify(new URL(url, location.href).href)}); for (const event of early) self.onmessage(event);`;
        super(URL.createObjectURL(new Blob([script], { type: 'text/javascript' })), { type: 'module' });
      }
    };
  });
};

describe('rooms that the server draws', () => {
  const suite = roomSuite();

  test('away from the camera’s place they are shown, one request at a time, and at it the video', async () => {
    const publisher = await suite.publish('attic');
    const views = { under: 0, most: 0, poses: [], tags: new Set() };
    const { page, context, errors } = await suite.watch('attic', { prepare: blind });
    const isView = (request) => request.url().includes('/frames/latest/view?');
    page.on('request', (request) => {
      if (!isView(request)) return;
      views.poses.push(new URL(request.url()).searchParams.get('tx'));
      views.most = Math.max(views.most, ++views.under);
    });
    for (const event of ['requestfinished', 'requestfailed']) page.on(event, (request) => isView(request) && views.under--);
    page.on('response', (response) => isView(response.request()) && views.tags.add(response.headers()['x-tmpi-frame']));
    await waitForMode(page, 'flat');
    assert.deepEqual(views.poses, [], 'nothing is asked for where the video shows it');
    await page.locator('#stage').focus();
    for (let i = 0; i < 6; i++) await page.keyboard.press('ArrowLeft');
    await waitForMode(page, 'served');
    await page.getByText('The server draws this view.').waitFor();
    assert.equal(await seen(page), 'hidden');
    // it goes on without being moved
    await page.waitForFunction(() => window.viewer.poster.naturalWidth > 0);
    await until(() => views.tags.size >= 4);
    assert.ok(views.poses.every((tx) => Number(tx) < 0) && views.most === 1, `${views.poses}; ${views.most} at once`);
    const away = likenessOf(await servedPixels(page));
    // the film from a little beside
    assert.ok(away.same > 10 && away.same < SAME_DB, `${away.same} dB`);
    await shoot(page, 'watch-served');
    await page.keyboard.press('0');
    await waitForMode(page, 'flat');
    assert.equal(await seen(page), 'visible');
    await page.waitForFunction(() => !window.viewer.moving);
    await until(() => views.under === 0);
    const asked = views.poses.length;
    await showsFrames(page, 20);
    assert.equal(views.poses.length, asked, 'no more is asked for');
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });

  test('where the server refuses the video stays, and views come once it does not', async () => {
    const publisher = await suite.publish('cellar');
    let refuses = true;
    const prepare = async (page) => {
      await blind(page);
      await page.route('**/frames/latest/view?*', (route) =>
        refuses ? route.fulfill({ status: 429, headers: { 'retry-after': '1' }, body: '{}' }) : route.continue(),
      );
    };
    const { page, context } = await suite.watch('cellar', { prepare });
    await waitForMode(page, 'flat');
    await page.locator('#stage').focus();
    const refused = page.waitForResponse((response) => response.status() === 429);
    for (let i = 0; i < 6; i++) await page.keyboard.press('ArrowRight');
    await refused;
    await page.waitForResponse((response) => response.status() === 429);
    assert.equal(await page.locator('#stage').getAttribute('data-mode'), 'flat');
    assert.equal(await seen(page), 'visible');
    refuses = false;
    await waitForMode(page, 'served');
    refuses = true;
    await waitForMode(page, 'flat');
    await context.close();
    await publisher.context.close();
  });

  test('without a decoder for the video all of it is the server’s', async () => {
    const publisher = await suite.publish('garden');
    const codec = await publisher.page.evaluate(() => window.publisher.codec);
    assert.notEqual(codec, 'jpeg', 'pictures need no decoder');
    const { page, context } = await suite.watch('garden', { prepare: undecoded });
    await waitForMode(page, 'served');
    assert.equal(await page.evaluate(() => document.body.dataset.state), 'live');
    assert.ok(await page.locator('#failure').isHidden());
    const home = likenessOf(await servedPixels(page));
    assert.ok(home.same > 18 && home.same > home.other + 2, `${home.same} dB, half a film away ${home.other} dB`);
    await shoot(page, 'watch-served-alone');
    await publisher.page.getByRole('button', { name: 'Stop' }).click();
    // the last frame is kept for as long as the publisher may come back
    await page.waitForFunction(() => document.body.dataset.state === 'stalled');
    await page.waitForFunction(() => document.body.dataset.state === 'ended', null, { timeout: 40_000 });
    await context.close();
    await publisher.context.close();
  });
});

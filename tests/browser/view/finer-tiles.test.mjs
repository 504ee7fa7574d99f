// Zooming into a large photo loads the visible tiles of a finer level and draws them over the coarse one.
import assert from 'node:assert/strict';
import { after, before, describe, test } from 'node:test';
import { disableGraphics, launch, openPage, waitForMode } from '../support/browser.mjs';
import { boxDepth, inBox, png } from '../support/pictures.mjs';
import { makePhoto, startServer } from '../support/program.mjs';

const [WIDTH, HEIGHT] = [1600, 1000];
/** One-pixel stripes, which turn grey at half size. */
const stripes = png(WIDTH, HEIGHT, 1, (x, y) => [(x % 2 ? 210 : 50) + (inBox(x, y, WIDTH, HEIGHT) ? 30 : 0)]);

describe('finer tiles', () => {
  let server;
  let browser;
  let photo;
  before(async () => {
    server = await startServer();
    browser = await launch();
    photo = await makePhoto(server.url, stripes, boxDepth(WIDTH, HEIGHT));
  });
  after(async () => {
    await browser?.close();
    await server?.close();
  });

  /** Mean difference between neighbouring pixels of the view in levels. */
  const contrast = (page) =>
    page.evaluate(async () => {
      const image = await createImageBitmap(await window.viewer.picture());
      const context = new OffscreenCanvas(image.width, image.height).getContext('2d');
      context.drawImage(image, 0, 0);
      const { data } = context.getImageData(0, image.height >> 1, image.width, 1);
      let sum = 0;
      for (let i = 4; i < data.length; i += 4) sum += Math.abs(data[i] - data[i - 4]);
      return sum / (data.length / 4 - 1);
    });

  for (const mode of ['gpu', 'webgl']) {
    test(`appear when zoomed in, also from the side (${mode})`, async (t) => {
      const { page, context, errors } = await openPage(browser, { viewport: { width: 640, height: 480 } });
      if (mode === 'webgl') await disableGraphics(page, { webgl: true });
      const requests = [];
      page.on('request', (request) => request.url().includes('region=') && requests.push(new URL(request.url()).searchParams));
      await page.goto(`${server.url}/view/${photo.id}`);
      await waitForMode(page, mode);
      assert.ok((await page.evaluate(() => window.viewer.head.width)) < WIDTH, 'a smaller level is loaded');
      const before = await contrast(page);
      const readout = await page.evaluate(() => {
        window.viewer.zoomBy(100);
        return document.getElementById('readout').textContent;
      });
      assert.equal(readout, '200 %', 'the readout shows twice the photo’s resolution at once');
      await page.waitForFunction(() => document.querySelectorAll('.tmpi-canvas').length === 2);
      const close = await contrast(page);
      await page.evaluate(() => window.viewer.moveTo({ x: 0.8, y: 0.3, z: 0 }));
      const moved = await contrast(page);
      t.diagnostic(`contrast ${before.toFixed(1)} of the whole photo, ${close.toFixed(1)} close, ${moved.toFixed(1)} close from the side`);
      assert.ok(close > 30 && moved > 20 && before < 10, `${before} ${close} ${moved}`);
      assert.equal(requests.length > 0 && requests[0].get('level'), '0');
      await page.evaluate(() => window.viewer.reset());
      await page.waitForFunction(() => document.querySelectorAll('.tmpi-canvas').length === 1);
      assert.deepEqual(errors, []);
      await context.close();
    });
  }
});

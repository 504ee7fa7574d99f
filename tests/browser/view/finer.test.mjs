// Who comes closer to a large photo sees its own pixels: the tiles in sight are fetched from a finer level and drawn over the coarse one.
import assert from 'node:assert/strict';
import { after, before, describe, test } from 'node:test';
import { launch, openPage, takeGraphics, waitForMode } from '../support/browser.mjs';
import { boxDepth, inBox, png } from '../support/pictures.mjs';
import { makePhoto, startServer } from '../support/program.mjs';
import { STILL } from '../support/suite.mjs';

const [WIDTH, HEIGHT] = [1600, 1000];
/** Stripes of a pixel, which half the size turns into grey. */
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

  /** How much neighbouring pixels of the view differ, levels. */
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
    test(`by ${mode}, also from the side, and gone again at all of the photo`, async (t) => {
      const { page, context, errors } = await openPage(browser, { ...STILL, viewport: { width: 640, height: 480 } });
      if (mode === 'webgl') await takeGraphics(page, { webgl: true });
      const asked = [];
      page.on('request', (request) => request.url().includes('region=') && asked.push(new URL(request.url()).searchParams));
      await page.goto(`${server.url}/view/${photo.id}`);
      await waitForMode(page, mode);
      assert.ok((await page.evaluate(() => window.viewer.head.width)) < WIDTH, 'a smaller level is loaded');
      const before = await contrast(page);
      const told = await page.evaluate(() => {
        window.viewer.zoomBy(100);
        return document.getElementById('readout').textContent;
      });
      assert.equal(told, '200 %', 'twice the photo’s own pixels, said at once');
      await page.waitForFunction(() => document.querySelectorAll('.tmpi-canvas').length === 2);
      const own = await contrast(page);
      await page.evaluate(() => window.viewer.moveTo({ x: 0.8, y: 0.3, z: 0 }));
      const moved = await contrast(page);
      t.diagnostic(`contrast ${before.toFixed(1)} at all of it, ${own.toFixed(1)} close, ${moved.toFixed(1)} close from the side`);
      assert.ok(own > 30 && moved > 20 && before < 10, `${before} ${own} ${moved}`);
      assert.equal(asked.length > 0 && asked[0].get('level'), '0');
      await page.evaluate(() => window.viewer.reset());
      await page.waitForFunction(() => document.querySelectorAll('.tmpi-canvas').length === 1);
      assert.deepEqual(errors, []);
      await context.close();
    });
  }
});

// Rooms in browsers without graphics or without a video decoder.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { disableGraphics, waitForMode } from '../support/browser.mjs';
import { roomSuite } from '../support/room.mjs';

const withoutGraphics = (page) => disableGraphics(page, { webgl: false });
/** Removes the video decoder from the room's worker. */
const withoutDecoder = (page) =>
  page.addInitScript(() => {
    const { Worker: Plain } = window;
    window.Worker = class extends Plain {
      constructor(url) {
        const script = `delete self.VideoDecoder; const early = []; self.onmessage = (event) => early.push(event);
          await import(${JSON.stringify(new URL(url, location.href).href)}); for (const event of early) self.onmessage(event);`;
        super(URL.createObjectURL(new Blob([script], { type: 'text/javascript' })), { type: 'module' });
      }
    };
  });

describe('a room in a limited browser', () => {
  const suite = roomSuite();

  test('shows flat video without graphics', async () => {
    const publisher = await suite.publish('attic');
    const { page, context, errors } = await suite.watch('attic', { prepare: withoutGraphics });
    await waitForMode(page, 'flat');
    await page.getByText('This browser shows the video without depth.').waitFor();
    const isBright = () =>
      window.viewer.canvas
        .getContext('2d')
        .getImageData(0, 0, 16, 16)
        .data.some((v, i) => i % 4 < 3 && v > 0);
    await page.waitForFunction(isBright);
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });

  test('shows an error without a video decoder', async () => {
    const publisher = await suite.publish('garden');
    const codec = await publisher.page.evaluate(() => window.publisher.codec);
    assert.notEqual(codec, 'jpeg', 'JPEG pictures need no decoder');
    const { page, context } = await suite.watch('garden', { prepare: withoutDecoder });
    await page.locator('#failure').waitFor();
    assert.match(await page.locator('#failure-text').textContent(), /cannot decode the video/);
    await context.close();
    await publisher.context.close();
  });
});

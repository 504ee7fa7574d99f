// The overlay with the error of each tile.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { TileErrors } from '../../../static/draw/tile-errors.js';
import { waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

describe('tile errors', () => {
  const suite = boxSuite();

  test('the overlay shows the error of each tile', async () => {
    const { page, context, errors } = await suite.open();
    await waitForMode(page, 'gpu');
    for (const webgl of [false, true]) {
      if (webgl) {
        // WebGL shows the same
        for (let i = 0; i < 2; i++) {
          await page.evaluate(() => {
            window.lost = window.viewer.renderer;
            window.lost.device.destroy();
          });
          await page.waitForFunction(() => window.viewer.renderer && window.viewer.renderer !== window.lost);
        }
        await waitForMode(page, 'webgl');
      } else {
        await page.locator('#show').click();
        await page.getByText('How it is made').click();
        await page.getByLabel('Error').check();
      }
      const colours = () =>
        page.evaluate(async () => {
          const [w, h] = [200, 120];
          window.viewer.setPose({});
          const data = await window.viewer.readPixels(w, h);
          return [
            [10, 10],
            [190, 110],
          ].map(([x, y]) => [...data.subarray((y * w + x) * 4, (y * w + x) * 4 + 3)]);
        });
      await page.waitForFunction(async () => {
        const data = await window.viewer.readPixels(200, 120);
        return data[0] < data[1];
      });
      const [first, last] = await colours();
      assert.ok(first[1] > first[0] + 60, `the first tile has no error and must be green: ${first}`);
      assert.ok(last[0] > last[1] + 60, `the last tile has an error of one pixel and must be red: ${last}`);
    }
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('fetches the report on demand, and again after a failure', async (t) => {
    const answers = [new Response('', { status: 500 }), Response.json({ error: { tile_px: [1, 2] } })];
    const fetched = t.mock.method(globalThis, 'fetch', async () => answers.shift());
    const shown = [];
    const renderer = { setTileErrors: (errors) => shown.push(errors) };
    const errors = new TileErrors('/report');
    await errors.show(renderer);
    assert.equal(fetched.mock.callCount(), 0);
    errors.want();
    await assert.rejects(errors.show(renderer), /report/);
    errors.want();
    errors.want();
    await errors.show(renderer);
    assert.equal(fetched.mock.callCount(), 2);
    assert.deepEqual(shown, [[1, 2]]);
    const none = new TileErrors(undefined);
    none.want();
    await none.show(renderer);
    assert.equal(fetched.mock.callCount(), 2);
  });
});

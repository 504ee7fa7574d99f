// Overlays and the stereo view.
import assert from 'node:assert/strict';
import { before, describe, test } from 'node:test';
import { downloadBytes, filePixels, fractionDifferent, pixelsAt, waitForMode } from '../support/browser.mjs';
import { BOX, inBox } from '../support/pictures.mjs';
import { boxSuite, HEIGHT, WIDTH } from '../support/suite.mjs';

const HOME = {};

describe('draw mode', () => {
  const suite = boxSuite();
  let page;
  let errors;
  before(async () => {
    ({ page, errors } = await suite.open());
    await waitForMode(page, 'gpu');
  });

  test('saves a picture of the current view', async () => {
    const view = await pixelsAt(page, { tx: 0.02 }, WIDTH, HEIGHT);
    await page.getByRole('button', { name: 'Download' }).click();
    const [download] = await Promise.all([page.waitForEvent('download'), page.locator('#picture').click()]);
    assert.match(download.suggestedFilename(), /\.png$/);
    const picture = await downloadBytes(download);
    assert.deepEqual([picture.readUInt32BE(16), picture.readUInt32BE(20)], [WIDTH, HEIGHT]);
    assert.equal(fractionDifferent(await filePixels(page, picture), view, WIDTH, HEIGHT, { levels: 1 }), 0);
    await page.keyboard.press('Escape');
  });

  test('the menu shows depth, tiles and planes', async () => {
    const photo = await pixelsAt(page, HOME, WIDTH, HEIGHT);
    await page.locator('#show').click();
    const headset = page.getByRole('button', { name: 'Look around in a headset' });
    assert.equal(await headset.isVisible(), false, 'no button without a headset');
    const mean = (pixels, inside) => {
      let [sum, count] = [0, 0];
      for (let y = 0; y < HEIGHT; y++) {
        for (let x = 0; x < WIDTH; x++) {
          if (inBox(x, y, WIDTH, HEIGHT) !== inside) continue;
          sum += pixels[(y * WIDTH + x) * 4];
          count++;
        }
      }
      return sum / count;
    };
    await page.getByLabel('Depth').check();
    const depth = await pixelsAt(page, HOME, WIDTH, HEIGHT);
    assert.ok(Math.abs(mean(depth, true) - BOX.near * 255) < 12, `near is bright: ${mean(depth, true)}`);
    assert.ok(Math.abs(mean(depth, false) - BOX.far * 255) < 12, `far is dark: ${mean(depth, false)}`);
    await page.getByText('How it is made').click();
    const seen = [photo];
    for (const name of ['Tiles', 'Planes']) {
      await page.getByLabel(name).check();
      const tinted = await pixelsAt(page, HOME, WIDTH, HEIGHT);
      for (const other of seen) assert.ok(fractionDifferent(tinted, other, WIDTH, HEIGHT) > 0.5, name);
      seen.push(tinted);
    }
    await page.getByLabel('The photo').check();
    assert.equal(fractionDifferent(await pixelsAt(page, HOME, WIDTH, HEIGHT), photo, WIDTH, HEIGHT, { levels: 0 }), 0);
    assert.deepEqual(errors, []);
  });
});

// Depth of field from a lens aperture.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { apertureAt } from '../../../../static/draw/depth-of-field/aperture.js';
import { disableGraphics, evaluateBytes, filePixels, openPage, pixelsAt, waitForMode } from '../../support/browser.mjs';
import { BOX, inBox } from '../../support/pictures.mjs';
import { boxSuite } from '../../support/suite.mjs';

const WIDTH = 400;
const HEIGHT = 240;
/** A small page, for fast software rendering. */
const SMALL = { viewport: { width: 360, height: 360 } };

/** Sharpness of the box's left and right edges: the largest step between neighbours near them, averaged over rows. */
function sharpness(pixels) {
  let [sum, rows] = [0, 0];
  for (let y = 0; y < HEIGHT; y++) {
    for (let x = 4; x < WIDTH - 4; x++) {
      if (inBox(x, y, WIDTH, HEIGHT) === inBox(x + 1, y, WIDTH, HEIGHT)) continue;
      const at = (d) => pixels[(y * WIDTH + x + d) * 4 + 1];
      sum += Math.max(...[-3, -2, -1, 0, 1, 2].map((d) => Math.abs(at(d) - at(d + 1))));
      rows++;
    }
  }
  return sum / rows;
}

describe('depth of field', () => {
  const suite = boxSuite({ width: WIDTH, height: HEIGHT });

  test('aperture samples are centred for any even count', () => {
    for (const n of [8, 16, 64]) {
      const places = Array.from({ length: n }, (_, i) => apertureAt(i));
      const mean = (f) => places.reduce((sum, p) => sum + f(p), 0) / n;
      for (const axis of [0, 1]) {
        assert.ok(Math.abs(mean((p) => p[axis])) < 1e-12);
        // a quarter of the squared radius, as for the whole disc
        assert.ok(Math.abs(mean((p) => p[axis] ** 2) - 0.25) < 0.12, `${n}: ${mean((p) => p[axis] ** 2)}`);
      }
      assert.ok(places.every(([x, y]) => Math.hypot(x, y) <= 1));
    }
  });

  for (const mode of ['gpu', 'webgl']) {
    test(`only things out of focus blur (${mode})`, async (t) => {
      const { page, context, errors } = await openPage(suite.browser, SMALL);
      // hides the hint of a first visit, which covers the picture
      await page.addInitScript(() => localStorage.setItem('tmpi-hinted', '1'));
      if (mode === 'webgl') await disableGraphics(page, { webgl: true });
      await page.goto(`${suite.server.url}/view/box`);
      await waitForMode(page, mode);
      const sharp = await pixelsAt(page, {}, WIDTH, HEIGHT);
      await page.locator('#show').click();
      await page.locator('#blur').fill('1');
      await page.keyboard.press('Escape');
      assert.equal(await page.evaluate(() => window.viewer.blur), 1);
      const settled = () => page.waitForFunction(() => !window.viewer.moving);
      /** The saved picture, and its mean difference to the canvas in levels. */
      const picture = async () => {
        // the pointer moved the camera
        await page.evaluate(() => window.viewer.setPose({}));
        await settled();
        const decoded = (file) => filePixels(page, file, { width: WIDTH, height: HEIGHT });
        const saved = await decoded(
          await evaluateBytes(page, async () => new Uint8Array(await (await window.viewer.picture()).arrayBuffer())),
        );
        const shown = await decoded(await page.locator('canvas.tmpi-canvas').screenshot());
        return { pixels: saved, off: saved.reduce((sum, v, i) => sum + Math.abs(v - shown[i]), 0) / saved.length };
      };
      const clickAt = async (x, y) => {
        const { x: left, y: top, width, height } = await page.locator('canvas.tmpi-canvas').boundingBox();
        await page.mouse.click(left + x * width, top + y * height);
      };
      let middle = null;
      for (let y = 0; y < HEIGHT && !middle; y++) {
        for (let x = 0; x < WIDTH; x++)
          if (inBox(x - 15, y - 15, WIDTH, HEIGHT) && inBox(x + 15, y + 15, WIDTH, HEIGHT)) middle = [x / WIDTH, y / HEIGHT];
      }
      for (const near of [true, false]) {
        const focused = page.waitForFunction((was) => window.viewer.focus !== was, await page.evaluate(() => window.viewer.focus));
        await clickAt(...(near ? middle : [0.03, 0.06]));
        await focused;
        const focus = await page.evaluate(() => window.viewer.focus);
        assert.ok(Math.abs(focus - (near ? BOX.near : BOX.far)) < 0.02, `focus ${focus}`);
        const { pixels, off } = await picture();
        const kept = sharpness(pixels) / sharpness(sharp);
        assert.ok(
          near ? kept > 0.7 : kept < 0.4,
          `with the ${near ? 'box' : 'wall'} in focus the box's edges keep ${kept} of their sharpness`,
        );
        t.diagnostic(
          `${near ? 'box' : 'wall'} in focus: ${kept.toFixed(2)} of the edges, canvas ${off.toFixed(2)} levels from the file, focus ${focus.toFixed(3)}`,
        );
        assert.ok(off < 3, `the canvas differs from the saved picture by ${off} levels`);
      }
      await page.locator('#show').click();
      await page.locator('#blur').fill('0');
      assert.deepEqual(await pixelsAt(page, {}, WIDTH, HEIGHT), sharp);
      assert.deepEqual(errors, []);
      await context.close();
    });
  }
});

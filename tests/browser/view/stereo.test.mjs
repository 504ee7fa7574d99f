// Both eyes' views: side by side, crossed and as anaglyphs, and the limit of their parallax.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { columnsOf, EYES, eyes, HOME, WHOLE } from '../../../static/view/camera.js';
import { evaluateBytes, waitForMode } from '../support/browser.mjs';
import { BOX_HEAD } from '../support/container.mjs';
import { boxSuite } from '../support/suite.mjs';

const SIZE = { width: 200, height: 120 };

/** Column at which a view shows the point at the photo's centre and disparity `delta`, in shares of the view's width. */
const column = ({ pose, k, width }, delta) => (k.cx - k.fx * pose.tx * delta) / width;

describe('both eyes', () => {
  for (const focus of [0, 0.3, 1]) {
    for (const [name, distance, scale] of [
      ['near together', EYES, 1],
      ['far apart', 6 * EYES, 1],
      ['zoomed in', EYES, 8],
    ]) {
      test(`${name}, with disparity ${focus} in the screen, no point is more than 3 % of the width apart`, () => {
        const { views, narrowed } = eyes(HOME, BOX_HEAD, SIZE, focus, { ...WHOLE, scale }, { layout: 'anaglyph', distance });
        const parallax = (delta) => column(views[1], delta) - column(views[0], delta);
        assert.ok(Math.abs(parallax(focus)) < 1e-12, 'what lies in the screen is at the same place');
        const [far, near] = [parallax(0), parallax(1)];
        assert.ok(far >= 0 && near <= 0, `far things lie behind the screen, near ones before it: ${far}, ${near}`);
        const most = Math.max(far, -near);
        assert.ok(most < 0.03 + 1e-12, `${most}`);
        const apart = views[1].pose.tx - views[0].pose.tx;
        if (narrowed) assert.ok(apart < distance && most > 0.03 - 1e-12, `no closer together than necessary: ${most}`);
        else assert.ok(Math.abs(apart - distance) < 1e-12);
        assert.equal(narrowed, name !== 'near together');
      });
    }
  }

  const suites = { gpu: boxSuite(), webgl: boxSuite({ webgpu: false }) };
  for (const [mode, suite] of Object.entries(suites)) {
    test(`each eye gets its place or its channels (${mode})`, async () => {
      const { page, context, errors } = await suite.open({ viewport: { width: 400, height: 400 } });
      await waitForMode(page, mode);
      await page.locator('#show').click();
      for (const [layout, [left, right]] of Object.entries({
        sbs: [0, 1],
        crossed: [1, 0],
        anaglyph: [[0], [1, 2]],
        'anaglyph-green-magenta': [[1], [0, 2]],
        'anaglyph-amber-blue': [[0, 1], [2]],
      })) {
        await page.locator('#stereo').selectOption(layout);
        const { across, width, height } = await page.evaluate(async (name) => {
          const { eyes } = await import('/static/view/camera.js');
          const { viewer } = window;
          viewer.setPose({ tx: 0.01 });
          const { canvas, pose, head, pivot } = viewer;
          const whole = { scale: 1, x: 0.5, y: 0.5 };
          viewer.render();
          // in the same task, before the browser takes the picture away
          const pen = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d');
          pen.drawImage(canvas, 0, 0);
          const both = eyes(pose, head, canvas, pivot, whole, { layout: name, distance: viewer.eyeDistance }).views;
          window.pictures = [pen.getImageData(0, 0, canvas.width, canvas.height).data];
          for (const { pose, k, width, height } of both) window.pictures.push(await viewer.renderer.readPixels(pose, k, width, height));
          return { across: canvas.width, width: both[0].width, height: both[0].height };
        }, layout);
        const [drawn, ...views] = await Promise.all([0, 1, 2].map((i) => evaluateBytes(page, async (n) => window.pictures[n], i)));
        assert.equal(columnsOf(layout), Math.floor(across / width));
        let [own, apart] = [0, 0];
        for (let y = 0; y < height; y++) {
          for (let x = 0; x < width; x++) {
            for (let c = 0; c < 3; c++) {
              [left, right].forEach((place, eye) => {
                if (Array.isArray(place) && !place.includes(c)) return;
                const at = y * across + x + (Array.isArray(place) ? 0 : place * width);
                const value = drawn[at * 4 + c];
                const i = (y * width + x) * 4 + c;
                own += Math.abs(value - views[eye][i]) > 2;
                apart += Math.abs(value - views[1 - eye][i]) > 2;
              });
            }
          }
        }
        assert.ok(own < 1e-3 * width * height, `${layout}: ${own} values are not those of the eye`);
        assert.ok(apart > 1e-2 * width * height, `${layout}: the eyes see the same, ${apart}`);
      }
      // the page says where it brings the eyes together
      const hint = page.locator('#eyes-hint');
      const shape = () => page.evaluate(() => window.viewer.canvas.clientWidth / window.viewer.canvas.clientHeight);
      await page.locator('#stereo').selectOption('');
      const one = await shape();
      await page.locator('#stereo').selectOption('sbs');
      assert.ok(Math.abs((await shape()) / one - 2) < 0.05, 'the picture has twice the aspect ratio');
      assert.equal(await hint.textContent(), '');
      await page.locator('#eyes').fill('3');
      assert.match(await hint.textContent(), /3 %/);
      await page.locator('#eyes').fill('1');
      assert.equal(await hint.textContent(), '');
      await page.locator('#eyes').fill('3');
      await page.locator('#stereo').selectOption('');
      assert.equal(await hint.textContent(), '');
      assert.deepEqual(errors, []);
      await context.close();
    });
  }
});

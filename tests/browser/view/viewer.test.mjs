// The viewer alone, with a hand-written container and a static file server.
import assert from 'node:assert/strict';
import { before, describe, test } from 'node:test';
import { fractionDifferent, imagePixels, openPage, pixelsAt, seriousViolations, waitForMode } from '../support/browser.mjs';
import { BOX, boxPhoto, inBox, readPng, wall } from '../support/pictures.mjs';
import { boxSuite, HEIGHT, WIDTH } from '../support/suite.mjs';
import { gate } from '../support/until.mjs';

const HOME = {};

/** Expected picture of the box and wall for a camera at `tx`, without the soft edge. */
function expected(tx) {
  const focal = 0.58 * WIDTH;
  const out = new Uint8ClampedArray(WIDTH * HEIGHT * 4);
  const photo = readPng(boxPhoto(WIDTH, HEIGHT)).data;
  for (let y = 0; y < HEIGHT; y++) {
    for (let x = 0; x < WIDTH; x++) {
      const boxX = Math.round(x + focal * tx * BOX.near);
      const wallX = x + focal * tx * BOX.far;
      const colour = inBox(boxX, y, WIDTH, HEIGHT) ? photo.subarray((y * WIDTH + boxX) * 4, (y * WIDTH + boxX) * 4 + 3) : wall(wallX, y);
      out.set([...colour, 255], (y * WIDTH + x) * 4);
    }
  }
  return out;
}

describe('viewer', () => {
  const suite = boxSuite();

  /** A page with the photo, for the tests that only look at it. */
  let page;
  before(async () => {
    ({ page } = await suite.open());
    await waitForMode(page, 'gpu');
  });

  test('shows the photo first, then the scene', async (t) => {
    const rest = gate();
    t.after(rest.open);
    suite.server.held.atlas = rest.opened;
    const { page, context, errors } = await suite.open();
    await page.waitForFunction(() => document.querySelector('.tmpi-poster')?.naturalWidth);
    const poster = await imagePixels(page, '.tmpi-poster', WIDTH, HEIGHT);
    assert.equal(fractionDifferent(poster, readPng(boxPhoto(WIDTH, HEIGHT)).data, WIDTH, HEIGHT, { levels: 2 }), 0);
    assert.equal(await page.evaluate(() => window.viewer.mode), 'loading');
    rest.open();
    await waitForMode(page, 'gpu');
    assert.ok(await page.locator('#loading').isHidden());
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('the reference view equals the photo', async () => {
    const got = await pixelsAt(page, HOME, WIDTH, HEIGHT);
    const photo = readPng(boxPhoto(WIDTH, HEIGHT)).data;
    const share = fractionDifferent(got, photo, WIDTH, HEIGHT, { levels: 2 });
    assert.ok(share < 0.001, `${share} of the pixels differ`);
  });

  test('from the side the box moves and reveals the wall', async () => {
    // 5 pixels of parallax for the box, 0.55 for the wall
    const tx = 5 / (0.58 * WIDTH) / BOX.near;
    for (const side of [tx, -tx]) {
      const got = await pixelsAt(page, { tx: side }, WIDTH, HEIGHT);
      // the expected picture lacks the left and right border and the soft edge
      const share = fractionDifferent(got, expected(side), WIDTH, HEIGHT, { levels: 12, x0: 0.02, x1: 0.98 });
      assert.ok(share < 0.03, `${share} of the pixels differ at ${side}`);
      const still = fractionDifferent(await pixelsAt(page, HOME, WIDTH, HEIGHT), expected(side), WIDTH, HEIGHT, { levels: 12 });
      assert.ok(still > 0.1, `the comparison must detect a view that does not move: ${still}`);
    }
  });

  test('draws nothing while nothing moves', async () => {
    // releases the pose that another test holds, so that the camera comes to rest by itself
    await page.evaluate(() => window.viewer.moveTo({ x: 0.3, y: 0, z: 0 }));
    await page.waitForFunction(() => !window.viewer.moving);
    const drawn = await page.evaluate(async () => {
      let count = 0;
      const { viewer } = window;
      const draw = viewer.renderer.draw.bind(viewer.renderer);
      viewer.renderer.draw = (...args) => {
        count++;
        draw(...args);
      };
      for (let i = 0; i < 30; i++) await new Promise(requestAnimationFrame);
      const still = count;
      viewer.moveTo({ x: 0.5, y: 0, z: 0 });
      for (let i = 0; i < 600 && count === still; i++) await new Promise(requestAnimationFrame);
      return { still, moved: count - still };
    });
    assert.equal(drawn.still, 0);
    assert.ok(drawn.moved > 0, 'the counter works');
  });

  test('no corner of the view box sees past the border', async () => {
    const uncovered = await page.evaluate(async () => {
      let uncovered = 0;
      for (const x of [-1, 1]) {
        for (const y of [-1, 1]) {
          for (const z of [-1, 1]) {
            window.viewer.moveTo({ x, y, z });
            const data = await window.viewer.readPixels();
            for (let i = 3; i < data.length; i += 4) if (data[i] < 250) uncovered++;
          }
        }
      }
      return uncovered;
    });
    assert.equal(uncovered, 0);
  });

  test('has no serious accessibility violations', async () => {
    await page.locator('#show').click();
    for (const colorScheme of ['light', 'dark']) {
      await page.emulateMedia({ colorScheme });
      assert.deepEqual(await seriousViolations(page), []);
    }
  });

  test('a shared link restores the pose', async () => {
    const { page, context } = await suite.open({}, '#pose=0.5,-0.25,0.1');
    await waitForMode(page, 'gpu');
    const pose = await page.evaluate(() => window.viewer.pose);
    assert.ok(
      Math.abs(pose.tx - 0.015) < 1e-6 && Math.abs(pose.ty + 0.0075) < 1e-6 && Math.abs(pose.tz - 0.003) < 1e-6,
      JSON.stringify(pose),
    );
    await page.evaluate(() => Object.defineProperty(navigator, 'clipboard', { value: undefined }));
    await page.locator('#share').click();
    await page.locator('#share-link').click();
    assert.equal(await page.locator('#link').inputValue(), `${suite.server.url}/view/box#pose=0.5,-0.25,0.1`);
    await context.close();
  });

  test('a missing photo shows an error', async () => {
    const { page, context } = await openPage(suite.browser);
    await page.goto(`${suite.server.url}/view/none`);
    await page.locator('#failure').waitFor();
    assert.match(await page.locator('#failure-text').textContent(), /There is no photo at this address/);
    await context.close();
  });
});

// The viewer by itself: a container written by hand, a server that does nothing but serve files.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { after, before, describe, test } from 'node:test';
import { launch, openPage, pixelsAt, seriousViolations, shareDifferent, takeGraphics, waitForMode } from './browser.mjs';
import { boxScene, container } from './fixture.mjs';
import { boxPhoto, BOX, inBox, readPng, wall } from './pictures.mjs';
import { serve } from './static-server.mjs';

const WIDTH = 200;
const HEIGHT = 120;
const HOME = {};

/** The box before the wall for a camera at `tx`, drawn by hand; the soft rim is left out. */
function expected(tx) {
  const focal = 0.58 * WIDTH;
  const out = new Uint8ClampedArray(WIDTH * HEIGHT * 4);
  const photo = readPng(boxPhoto(WIDTH, HEIGHT)).data;
  for (let y = 0; y < HEIGHT; y++) {
    for (let x = 0; x < WIDTH; x++) {
      const near = Math.round(x + focal * tx * BOX.near);
      const far = x + focal * tx * BOX.far;
      const colour = inBox(near, y, WIDTH, HEIGHT) ? photo.subarray((y * WIDTH + near) * 4, (y * WIDTH + near) * 4 + 3) : wall(far, y);
      out.set([...colour, 255], (y * WIDTH + x) * 4);
    }
  }
  return out;
}

describe('viewer', () => {
  let server;
  let browser;
  before(async () => {
    server = await serve({ atlas: container(boxScene(WIDTH, HEIGHT)), delayMs: 400 });
    browser = await launch();
  });
  after(async () => {
    await browser?.close();
    await server?.close();
  });

  const open = async (options, hash = '') => {
    const opened = await openPage(browser, options);
    await opened.page.goto(`${server.url}/view/box${hash}`);
    return opened;
  };

  test('shows the photo first, then the scene', async () => {
    const { page, context, errors } = await open();
    await page.waitForFunction(() => document.querySelector('.tmpi-poster')?.src.startsWith('blob:'));
    assert.equal(await page.evaluate(() => window.viewer.mode), 'loading');
    await waitForMode(page, 'gpu');
    assert.ok(await page.locator('#loading').isHidden());
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('the view from the photo’s own place is the photo', async () => {
    const { page, context } = await open();
    await waitForMode(page, 'gpu');
    const got = await pixelsAt(page, HOME, WIDTH, HEIGHT);
    const photo = readPng(boxPhoto(WIDTH, HEIGHT)).data;
    const share = shareDifferent(got, photo, WIDTH, HEIGHT, { levels: 2 });
    assert.ok(share < 0.001, `${share} of the pixels differ`);
    await context.close();
  });

  test('from the side the box moves before the wall, and the wall behind it appears', async () => {
    const { page, context } = await open();
    await waitForMode(page, 'gpu');
    // 5 pixels of parallax for the box, 0.55 for the wall
    const tx = 5 / (0.58 * WIDTH) / BOX.near;
    for (const side of [tx, -tx]) {
      const got = await pixelsAt(page, { tx: side }, WIDTH, HEIGHT);
      // the left and right border and the soft rim are not in the drawing by hand
      const share = shareDifferent(got, expected(side), WIDTH, HEIGHT, { levels: 12, x0: 0.02, x1: 0.98 });
      assert.ok(share < 0.03, `${share} of the pixels differ at ${side}`);
      const still = shareDifferent(await pixelsAt(page, HOME, WIDTH, HEIGHT), expected(side), WIDTH, HEIGHT, { levels: 12 });
      assert.ok(still > 0.1, `the drawings would not tell a view that stands still: ${still}`);
    }
    await context.close();
  });

  test('keys, drag, wheel and buttons move the camera, within the view box', async () => {
    const { page, context, errors } = await open({ reducedMotion: 'reduce' });
    await waitForMode(page, 'gpu');
    // input reaches the page some time after it is sent: wait for what it has to lead to
    const comesTo = async (what, key, least, most) => {
      const there = ([k, from, to]) => !window.viewer.moving && window.viewer.pose[k] >= from && window.viewer.pose[k] <= to;
      await page.waitForFunction(there, [key, least, most], { timeout: 10_000 }).catch(async () => {
        assert.fail(`${what}: ${JSON.stringify(await page.evaluate(() => window.viewer.pose))}`);
      });
    };
    await page.locator('#stage').focus();
    for (let i = 0; i < 3; i++) await page.keyboard.press('ArrowRight');
    await comesTo('three steps to the right', 'tx', 0.01, 0.027);
    for (let i = 0; i < 30; i++) await page.keyboard.press('ArrowRight');
    await comesTo('the limit', 'tx', 0.027, 0.03);
    await page.keyboard.press('0');
    await comesTo('back', 'tx', 0, 0);
    await page.keyboard.press('+');
    await comesTo('closer', 'tz', 0.003, 0.03);
    await page.keyboard.press('Home');
    await comesTo('back', 'tz', 0, 0);
    const box = await page.locator('#stage').boundingBox();
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    await page.mouse.down();
    await page.mouse.move(box.x + box.width / 2 + 150, box.y + box.height / 2, { steps: 5 });
    await page.mouse.up();
    await comesTo('near things follow the pointer', 'tx', -0.03, -0.005);
    await page.locator('#reset').click();
    await comesTo('reset', 'tx', -1e-4, 1e-4);
    await page.mouse.move(box.x + box.width / 2, box.y + box.height / 2);
    await page.mouse.wheel(0, -200);
    await comesTo('the wheel', 'tz', 0.003, 0.03);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('moves by itself, but not for those who asked for less motion', async () => {
    const moved = async (options) => {
      const { page, context } = await open(options);
      await waitForMode(page, 'gpu');
      const pressed = await page.locator('#idle').getAttribute('aria-pressed');
      await page.waitForTimeout(2500);
      const pose = await page.evaluate(() => window.viewer.pose);
      await page.locator('#stage').focus();
      await page.keyboard.press(' ');
      const toggled = await page.locator('#idle').getAttribute('aria-pressed');
      await context.close();
      return { pressed, toggled, far: Math.abs(pose.tx) + Math.abs(pose.ty) };
    };
    const usual = await moved({});
    assert.ok(usual.far > 1e-4, `${usual.far}`);
    assert.deepEqual([usual.pressed, usual.toggled], ['true', 'false']);
    const calm = await moved({ reducedMotion: 'reduce' });
    assert.equal(calm.far, 0);
    assert.deepEqual([calm.pressed, calm.toggled], ['false', 'true']);
  });

  test('draws nothing while nothing moves', async () => {
    const { page, context } = await open({ reducedMotion: 'reduce' });
    await waitForMode(page, 'gpu');
    const frames = await page.evaluate(async () => {
      await new Promise((resume) => setTimeout(resume, 500));
      let count = 0;
      const draw = window.viewer.renderer.draw.bind(window.viewer.renderer);
      window.viewer.renderer.draw = (...args) => {
        count++;
        draw(...args);
      };
      await new Promise((resume) => setTimeout(resume, 700));
      return count;
    });
    assert.equal(frames, 0);
    await context.close();
  });

  test('no corner of the view box sees past the border', async () => {
    const { page, context } = await open({ reducedMotion: 'reduce' });
    await waitForMode(page, 'gpu');
    const open8 = await page.evaluate(async () => {
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
    assert.equal(open8, 0);
    await context.close();
  });

  test('a lost device is rebuilt once; then WebGL draws, and after two more losses the server', async () => {
    const { page, context } = await open({ reducedMotion: 'reduce' });
    await waitForMode(page, 'gpu');
    const before = await pixelsAt(page, { tx: 0.02 }, WIDTH, HEIGHT);
    await page.evaluate(() => window.viewer.renderer.device.destroy());
    await waitForMode(page, 'loading');
    await waitForMode(page, 'gpu');
    const rebuilt = await pixelsAt(page, { tx: 0.02 }, WIDTH, HEIGHT);
    assert.equal(shareDifferent(before, rebuilt, WIDTH, HEIGHT, { levels: 0 }), 0);
    await page.evaluate(() => window.viewer.renderer.device.destroy());
    await waitForMode(page, 'webgl');
    const other = shareDifferent(before, await pixelsAt(page, { tx: 0.02 }, WIDTH, HEIGHT), WIDTH, HEIGHT);
    assert.ok(other < 0.005, `${other} of the pixels differ between WebGPU and WebGL2`);
    for (let i = 0; i < 2; i++) {
      await page.evaluate(() => {
        window.lost = window.viewer.renderer;
        window.lost.gl.getExtension('WEBGL_lose_context').loseContext();
      });
      await page.waitForFunction(() => window.viewer.renderer !== window.lost && window.viewer.mode !== 'loading');
    }
    await waitForMode(page, 'served');
    await page.waitForFunction(() => document.querySelector('.tmpi-poster').naturalWidth > 0);
    assert.equal(await page.locator('.tmpi-canvas').count(), 0);
    await context.close();
  });

  test('with neither WebGPU nor WebGL the server’s views are shown, one request at a time, the latest pose last', async () => {
    const { page, context, errors } = await openPage(browser);
    await takeGraphics(page, { webgl: false });
    await page.goto(`${server.url}/view/box`);
    await waitForMode(page, 'served');
    assert.match(await page.locator('#served-note').textContent(), /The server draws this view/);
    assert.match(await page.locator('#readout').textContent(), /drawn by the server/);
    await page.locator('#stage').focus();
    const seen = server.views.length;
    for (let i = 0; i < 12; i++) await page.keyboard.press('ArrowLeft');
    await page.waitForFunction(() => !window.viewer.moving && window.viewer.serverViews.shown === window.viewer.serverViews.wanted);
    assert.ok(server.views.length > seen);
    assert.equal(server.mostAtOnce(), 1);
    const last = new URLSearchParams(server.views.at(-1));
    assert.equal(last.get('tx'), '-0.03000');
    assert.ok(Number(last.get('fov')) > 60 && Number(last.get('fov')) < 82, last.get('fov'));
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('the menu shows depth, tiles and planes, and a view for each eye', async () => {
    const { page, context, errors } = await open({ reducedMotion: 'reduce' });
    await waitForMode(page, 'gpu');
    const photo = await pixelsAt(page, HOME, WIDTH, HEIGHT);
    await page.locator('#show').click();
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
    for (const name of ['Tiles', 'Planes']) {
      await page.getByLabel(name).check();
      const tinted = await pixelsAt(page, HOME, WIDTH, HEIGHT);
      assert.ok(shareDifferent(tinted, photo, WIDTH, HEIGHT) > 0.5, name);
    }
    await page.getByLabel('The photo').check();
    assert.equal(shareDifferent(await pixelsAt(page, HOME, WIDTH, HEIGHT), photo, WIDTH, HEIGHT, { levels: 0 }), 0);
    const shape = () => page.evaluate(() => window.viewer.canvas.clientWidth / window.viewer.canvas.clientHeight);
    const [one] = [await shape()];
    await page.getByLabel('Side by side').check();
    assert.ok(Math.abs((await shape()) / one - 2) < 0.05, 'twice as wide for its height');
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('the picture of this view is saved', async () => {
    const { page, context } = await open({ reducedMotion: 'reduce' });
    await waitForMode(page, 'gpu');
    await page.evaluate(() => window.viewer.setPose({ tx: 0.02 }));
    await page.getByRole('button', { name: 'Download' }).click();
    const [download] = await Promise.all([page.waitForEvent('download'), page.locator('#picture').click()]);
    assert.match(download.suggestedFilename(), /\.png$/);
    const saved = readPng(readFileSync(await download.path()));
    assert.deepEqual([saved.width, saved.height], [WIDTH, HEIGHT]);
    await context.close();
  });

  test('nothing stands in the way of people who do not see or point', async () => {
    for (const colorScheme of ['light', 'dark']) {
      const { page, context } = await open({ colorScheme, reducedMotion: 'reduce' });
      await waitForMode(page, 'gpu');
      await page.locator('#show').click();
      assert.deepEqual(await seriousViolations(page), []);
      await context.close();
    }
  });

  test('a shared address brings the same pose', async () => {
    const { page, context } = await open({ reducedMotion: 'reduce' }, '#pose=0.5,-0.25,0.1');
    await waitForMode(page, 'gpu');
    await page.locator('#share').click();
    const address = await page.evaluate(async () => document.getElementById('link').value || navigator.clipboard.readText().catch(() => ''));
    const pose = await page.evaluate(() => window.viewer.pose);
    assert.ok(Math.abs(pose.tx - 0.015) < 1e-6 && Math.abs(pose.ty + 0.0075) < 1e-6 && Math.abs(pose.tz - 0.003) < 1e-6, JSON.stringify(pose));
    if (address) assert.match(address, /#pose=0\.5,-0\.25,0\.1$|#pose=0\.5%2C-0\.25%2C0\.1$/);
    await context.close();
  });

  test('the element shows a photo on a page of another origin', async () => {
    const other = await serve({ atlas: Buffer.alloc(0) });
    const { page, context, errors } = await openPage(browser);
    await page.goto(`${other.url}/embed?host=${encodeURIComponent(server.url)}`);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer?.mode === 'gpu');
    const share = await page.evaluate(async () => {
      const { viewer } = document.querySelector('tmpi-viewer');
      viewer.setPose({ tx: 0.02 });
      const pixels = await viewer.readPixels();
      return pixels.filter((v) => v > 0).length / pixels.length;
    });
    assert.ok(share > 0.95, `${share} of the samples are not black`);
    assert.equal(await page.evaluate(() => document.querySelector('tmpi-viewer').viewer.idle), false);
    await page.evaluate(() => document.querySelector('tmpi-viewer').remove());
    assert.deepEqual(errors.filter((e) => !e.includes('favicon')), []);
    await context.close();
    await other.close();
  });

  test('three elements share a device, sleep out of sight and leave nothing behind', async () => {
    const { page, context, errors } = await openPage(browser);
    await page.goto(`${server.url}/embed/three`);
    const modes = () => page.evaluate(() => [...document.querySelectorAll('tmpi-viewer')].map((e) => e.viewer?.mode ?? null));
    const drawn = (n) => page.waitForFunction((i) => document.querySelectorAll('tmpi-viewer')[i].viewer?.mode === 'gpu', n);
    await drawn(0);
    await drawn(1);
    assert.equal((await modes())[2], null, 'what is far below is not fetched');
    await page.evaluate(() => document.querySelectorAll('tmpi-viewer')[2].scrollIntoView());
    await drawn(2);
    const seen = await page.evaluate(() => {
      const viewers = [...document.querySelectorAll('tmpi-viewer')].map((e) => e.viewer);
      return { devices: new Set(viewers.map((v) => v.renderer.device)).size, asleep: viewers.map((v) => v.asleep), idle: viewers.map((v) => v.idle) };
    });
    assert.deepEqual(seen, { devices: 1, asleep: [true, true, false], idle: [false, true, false] });
    const lost = await page.evaluate(async () => {
      const elements = [...document.querySelectorAll('tmpi-viewer')];
      const { device } = elements[0].viewer.renderer;
      elements[0].remove();
      elements[1].remove();
      const early = await Promise.race([device.lost.then(() => true), new Promise((r) => setTimeout(r, 300, false))]);
      elements[2].remove();
      return [early, (await device.lost).reason];
    });
    assert.deepEqual(lost, [false, 'destroyed'], 'the device goes with the last');
    assert.deepEqual(errors.filter((e) => !e.includes('favicon')), []);
    await context.close();
  });

  test('a photo that is not there: the reason is shown', async () => {
    const { page, context } = await openPage(browser);
    await page.goto(`${server.url}/view/none`);
    await page.locator('#failure').waitFor();
    assert.match(await page.locator('#failure-text').textContent(), /There is no \/v1\/photos\/none\/atlas/);
    await context.close();
  });
});

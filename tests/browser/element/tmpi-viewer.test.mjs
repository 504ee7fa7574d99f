// The element on pages of others.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage } from '../support/browser.mjs';
import { serve } from '../support/static-server.mjs';
import { boxSuite } from '../support/suite.mjs';

describe('element', () => {
  const suite = boxSuite();

  test('the element shows a photo on a page of another origin', async () => {
    const other = await serve({ atlas: Buffer.alloc(0) });
    const { page, context, errors } = await openPage(suite.browser);
    const asked = [];
    page.on('request', (request) => asked.push(new URL(request.url()).pathname));
    await page.goto(`${other.url}/embed?host=${encodeURIComponent(suite.server.url)}`);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer?.mode === 'gpu');
    const share = await page.evaluate(async () => {
      const { viewer } = document.querySelector('tmpi-viewer');
      viewer.setPose({ tx: 0.02 });
      const pixels = await viewer.readPixels();
      return pixels.filter((v) => v > 0).length / pixels.length;
    });
    assert.ok(share > 0.95, `${share} of the samples are not black`);
    const ofRooms = (path) => /^\/static\/(?:live|i18n)\/|\/element\/room\.js$/.test(path);
    assert.ok(asked.includes('/static/view/viewer.js') && !asked.some(ofRooms), `what rooms need is not fetched: ${asked.filter(ofRooms)}`);
    assert.equal(await page.evaluate(() => document.querySelector('tmpi-viewer').viewer.idle), false);
    await page.evaluate(() => document.querySelector('tmpi-viewer').remove());
    assert.deepEqual(
      errors.filter((e) => !e.includes('favicon')),
      [],
    );
    await context.close();
    await other.close();
  });

  test('a page says how its element moves, and how fast', async () => {
    const { page, context } = await openPage(suite.browser);
    await page.goto(`${suite.server.url}/embed?host=${encodeURIComponent(suite.server.url)}`);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer?.mode === 'gpu');
    const told = (motion, speed) =>
      page.evaluate(
        ([m, s]) => {
          const element = document.querySelector('tmpi-viewer');
          element.removeAttribute('still');
          element.setAttribute('motion', m);
          element.setAttribute('speed', s);
          const { style, rate } = element.viewer.motion;
          return [style, rate, element.viewer.idle];
        },
        [motion, speed],
      );
    assert.deepEqual(await told('orbit', '2'), ['orbit', 2, true]);
    assert.deepEqual((await told('none', '1'))[2], false);
    await context.close();
  });

  test('three elements share a device, sleep out of sight and leave nothing behind', async () => {
    const { page, context, errors } = await openPage(suite.browser);
    await page.goto(`${suite.server.url}/embed/three`);
    const modes = () => page.evaluate(() => [...document.querySelectorAll('tmpi-viewer')].map((e) => e.viewer?.mode ?? null));
    const drawn = (n) => page.waitForFunction((i) => document.querySelectorAll('tmpi-viewer')[i].viewer?.mode === 'gpu', n);
    await drawn(0);
    await drawn(1);
    assert.equal((await modes())[2], null, 'what is far below is not fetched');
    await page.evaluate(() => document.querySelectorAll('tmpi-viewer')[2].scrollIntoView());
    await drawn(2);
    const seen = await page.evaluate(() => {
      const viewers = [...document.querySelectorAll('tmpi-viewer')].map((e) => e.viewer);
      return {
        devices: new Set(viewers.map((v) => v.renderer.device)).size,
        asleep: viewers.map((v) => v.asleep),
        idle: viewers.map((v) => v.idle),
      };
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
    assert.deepEqual(
      errors.filter((e) => !e.includes('favicon')),
      [],
    );
    await context.close();
  });
});

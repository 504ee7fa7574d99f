// The element on pages of other sites.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { fractionDifferent, MOTION, openPage, pixelsAt } from '../support/browser.mjs';
import { serve } from '../support/fake-server.mjs';
import { boxPhoto, readPng } from '../support/pictures.mjs';
import { boxSuite, HEIGHT, WIDTH } from '../support/suite.mjs';
import { until, waitForAnimationFrames, waitForStill } from '../support/until.mjs';

describe('element', () => {
  const suite = boxSuite();

  test('shows a photo on a page of another origin', async () => {
    const other = await serve({ atlas: Buffer.alloc(0) });
    const { page, context, errors } = await openPage(suite.browser, MOTION);
    const requests = [];
    page.on('request', (request) => requests.push(new URL(request.url()).pathname));
    await page.goto(`${other.url}/embed?host=${encodeURIComponent(suite.server.url)}`);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer?.mode === 'gpu');
    const pixels = (pose) => pixelsAt(page, pose, WIDTH, HEIGHT, 'tmpi-viewer');
    const home = await pixels({});
    const off = fractionDifferent(home, readPng(boxPhoto(WIDTH, HEIGHT)).data, WIDTH, HEIGHT, { levels: 2 });
    assert.ok(off < 0.001, `${off} of the pixels differ from the photo`);
    assert.ok(fractionDifferent(home, await pixels({ tx: 0.03 }), WIDTH, HEIGHT) > 0.05, 'a moved camera changes the picture');
    const ofRooms = (path) => /^\/static\/live\/|\/i18n\/messages\.js$|\/element\/room\.js$/.test(path);
    assert.ok(requests.includes('/static/view/viewer.js') && !requests.some(ofRooms), `no room modules: ${requests.filter(ofRooms)}`);
    assert.equal(await page.evaluate(() => document.querySelector('tmpi-viewer').viewer.idle), false);
    await page.evaluate(() => document.querySelector('tmpi-viewer').remove());
    assert.deepEqual(
      errors.filter((e) => !e.includes('favicon')),
      [],
    );
    await context.close();
    await other.close();
  });

  test('attributes set motion and speed', async () => {
    const { page, context } = await openPage(suite.browser, MOTION);
    await page.goto(`${suite.server.url}/embed?host=${encodeURIComponent(suite.server.url)}`);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer?.mode === 'gpu');
    const setMotion = (motion, speed) =>
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
    const distance = () =>
      page.evaluate(() => {
        const { tx, ty } = document.querySelector('tmpi-viewer').viewer.pose;
        return Math.hypot(tx, ty);
      });
    assert.equal(await distance(), 0);
    assert.deepEqual(await setMotion('orbit', '2'), ['orbit', 2, true]);
    await until(async () => (await distance()) > 0.01);
    assert.deepEqual((await setMotion('none', '1'))[2], false);
    await waitForStill(page, { viewer: "document.querySelector('tmpi-viewer').viewer" });
    await waitForAnimationFrames(page, 10);
    assert.equal(await distance(), 0, 'the camera is back at rest');
    await context.close();
  });

  test('elements share a device, sleep unseen and clean up', async () => {
    const { page, context, errors } = await openPage(suite.browser, MOTION);
    await page.goto(`${suite.server.url}/embed/three`);
    const modes = () => page.evaluate(() => [...document.querySelectorAll('tmpi-viewer')].map((e) => e.viewer?.mode ?? null));
    const drawn = (n) => page.waitForFunction((i) => document.querySelectorAll('tmpi-viewer')[i].viewer?.mode === 'gpu', n);
    await drawn(0);
    await drawn(1);
    assert.equal((await modes())[2], null, 'an element far below does not load');
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
      let early = false;
      device.lost.then(() => (early = true));
      const pixels = await elements[2].viewer.readPixels(20, 12);
      early ||= pixels.every((v) => v === 0);
      elements[2].remove();
      return [early, (await device.lost).reason];
    });
    assert.deepEqual(lost, [false, 'destroyed'], 'the last element destroys the device');
    assert.deepEqual(
      errors.filter((e) => !e.includes('favicon')),
      [],
    );
    await context.close();
  });

  /** Opens a page with an element; its script loads after `prepare` has run on the element. */
  async function openBeforeScript(markup, prepare = () => {}) {
    const opened = await openPage(suite.browser);
    opened.requests = [];
    opened.page.on('request', (request) => opened.requests.push(request));
    await opened.page.goto(`${suite.server.url}/embed/blank`);
    await opened.page.evaluate((html) => (document.body.innerHTML = html), markup);
    await opened.page.locator('tmpi-viewer').evaluate(prepare);
    await opened.page.addScriptTag({ type: 'module', url: '/tmpi-viewer.js' });
    return opened;
  }
  const loaded = (page) => page.waitForFunction(() => document.querySelector('tmpi-viewer').loaded);
  const accessibleName = (page) => page.locator('tmpi-viewer .stage').getAttribute('aria-label');

  test('properties set before the script loads are kept', async () => {
    const { page, context, errors } = await openBeforeScript('<tmpi-viewer alt="An old name" still></tmpi-viewer>', (element) => {
      Object.assign(element, { src: '/v1/photos/box/atlas', alt: 'A box', speed: 2, poster: undefined });
    });
    await loaded(page);
    const state = await page
      .locator('tmpi-viewer')
      .evaluate((element) => [
        element.getAttribute('src'),
        element.src,
        element.getAttribute('speed'),
        element.hasAttribute('poster'),
        element.viewer.motion.rate,
      ]);
    assert.deepEqual(state, ['/v1/photos/box/atlas', '/v1/photos/box/atlas', '2', false, 2]);
    assert.equal(await accessibleName(page), 'A box');
    // later changes apply too
    await page.locator('tmpi-viewer').evaluate((element) => (element.src = null));
    assert.equal(await page.locator('tmpi-viewer').evaluate((element) => element.viewer ?? element.getAttribute('src')), null);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('room properties set before the script loads are kept', async () => {
    const { requests, context } = await openBeforeScript('<tmpi-viewer></tmpi-viewer>', (element) => {
      Object.assign(element, { room: 'attic', token: 'secret' });
    });
    const request = await until(() => requests.find((r) => new URL(r.url()).pathname === '/v1/live/attic'));
    assert.equal((await request.allHeaders()).authorization, 'Bearer secret');
    await context.close();
  });

  test('shows the latest src', async () => {
    const { page, context, errors } = await openBeforeScript('<tmpi-viewer></tmpi-viewer>');
    const element = page.locator('tmpi-viewer');
    // wait for the intersection observer
    await waitForAnimationFrames(page, 3);
    // src changes again before the viewer's modules have loaded
    await element.evaluate((e) => e.setAttribute('src', '/nowhere'));
    await element.evaluate((e) => e.setAttribute('src', '/v1/photos/box/atlas'));
    await loaded(page);
    assert.match(await element.evaluate((e) => e.viewer.options.atlas), /box\/atlas$/);
    // far below, it loads only with loading=eager
    await element.evaluate((e) => {
      e.remove();
      e.style.marginTop = '5000px';
      e.removeAttribute('src');
      document.body.append(e);
    });
    await waitForAnimationFrames(page, 3);
    await element.evaluate((e) => e.setAttribute('src', '/v1/photos/box/atlas'));
    await waitForAnimationFrames(page, 5);
    assert.equal(await element.evaluate((e) => e.viewer), null);
    await element.evaluate((e) => e.setAttribute('loading', 'eager'));
    await loaded(page);
    assert.ok(await element.evaluate((e) => e.viewer.asleep), 'an invisible element sleeps');
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('the accessible name follows aria-label, alt and title', async () => {
    const { page, context } = await openBeforeScript('<tmpi-viewer src="/nowhere" loading="eager" alt=""></tmpi-viewer>');
    const alert = page.getByRole('alert');
    await alert.waitFor();
    const name = (attribute, value) =>
      page
        .locator('tmpi-viewer')
        .evaluate((element, [a, v]) => (v === null ? element.removeAttribute(a) : element.setAttribute(a, v)), [attribute, value]);
    assert.equal(await accessibleName(page), '3D photo');
    for (const [attribute, value, wanted] of [
      ['title', 'By its title', 'By its title'],
      ['alt', 'By its text', 'By its text'],
      ['aria-label', 'By its label', 'By its label'],
      ['alt', 'By another text', 'By its label'],
      ['aria-label', null, 'By another text'],
    ]) {
      await name(attribute, value);
      assert.equal(await accessibleName(page), wanted);
      assert.ok((await alert.textContent()).includes(wanted), 'the error shows the name too');
    }
    await context.close();
  });
});

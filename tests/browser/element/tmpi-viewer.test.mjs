// The element on pages of others.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, pixelsAt, shareDifferent } from '../support/browser.mjs';
import { boxPhoto, readPng } from '../support/pictures.mjs';
import { serve } from '../support/static-server.mjs';
import { boxSuite, HEIGHT, STILL, WIDTH } from '../support/suite.mjs';
import { frames, until } from '../support/until.mjs';

describe('element', () => {
  const suite = boxSuite();

  test('the element shows a photo on a page of another origin', async () => {
    const other = await serve({ atlas: Buffer.alloc(0) });
    const { page, context, errors } = await openPage(suite.browser);
    const asked = [];
    page.on('request', (request) => asked.push(new URL(request.url()).pathname));
    await page.goto(`${other.url}/embed?host=${encodeURIComponent(suite.server.url)}`);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer?.mode === 'gpu');
    const seen = (pose) => pixelsAt(page, pose, WIDTH, HEIGHT, 'tmpi-viewer');
    const home = await seen({});
    const off = shareDifferent(home, readPng(boxPhoto(WIDTH, HEIGHT)).data, WIDTH, HEIGHT, { levels: 2 });
    assert.ok(off < 0.001, `${off} of the pixels are not the photo's`);
    assert.ok(shareDifferent(home, await seen({ tx: 0.03 }), WIDTH, HEIGHT) > 0.05, 'a moved camera sees something else');
    const ofRooms = (path) => /^\/static\/live\/|\/i18n\/messages\.js$|\/element\/room\.js$/.test(path);
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
    const away = () =>
      page.evaluate(() => {
        const { tx, ty } = document.querySelector('tmpi-viewer').viewer.pose;
        return Math.hypot(tx, ty);
      });
    assert.equal(await away(), 0);
    assert.deepEqual(await told('orbit', '2'), ['orbit', 2, true]);
    await until(async () => (await away()) > 0.01);
    assert.deepEqual((await told('none', '1'))[2], false);
    await page.waitForFunction(() => !document.querySelector('tmpi-viewer').viewer.moving);
    await frames(page, 10);
    assert.equal(await away(), 0, 'it came back and stands');
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
      let early = false;
      device.lost.then(() => (early = true));
      const pixels = await elements[2].viewer.readPixels(20, 12);
      early ||= pixels.every((v) => v === 0);
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

  /** A page with an element alone, and its script, which comes once `prepare` was done to the element. */
  async function early(markup, prepare = () => {}) {
    const opened = await openPage(suite.browser, STILL);
    opened.asked = [];
    opened.page.on('request', (request) => opened.asked.push(request));
    await opened.page.goto(`${suite.server.url}/embed/blank`);
    await opened.page.evaluate((html) => (document.body.innerHTML = html), markup);
    await opened.page.locator('tmpi-viewer').evaluate(prepare);
    await opened.page.addScriptTag({ type: 'module', url: '/tmpi-viewer.js' });
    return opened;
  }
  const loaded = (page) => page.waitForFunction(() => document.querySelector('tmpi-viewer').loaded);
  const named = (page) => page.locator('tmpi-viewer .stage').getAttribute('aria-label');

  test('properties that were set before its script came are taken over', async () => {
    const { page, context, errors } = await early('<tmpi-viewer alt="An old name" still></tmpi-viewer>', (element) => {
      Object.assign(element, { src: '/v1/photos/box/atlas', alt: 'A box', speed: 2, poster: undefined });
    });
    await loaded(page);
    const told = await page
      .locator('tmpi-viewer')
      .evaluate((element) => [
        element.getAttribute('src'),
        element.src,
        element.getAttribute('speed'),
        element.hasAttribute('poster'),
        element.viewer.motion.rate,
      ]);
    assert.deepEqual(told, ['/v1/photos/box/atlas', '/v1/photos/box/atlas', '2', false, 2]);
    assert.equal(await named(page), 'A box');
    // and what is set from then on counts
    await page.locator('tmpi-viewer').evaluate((element) => (element.src = null));
    assert.equal(await page.locator('tmpi-viewer').evaluate((element) => element.viewer ?? element.getAttribute('src')), null);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('so are those of a room', async () => {
    const { asked, context } = await early('<tmpi-viewer></tmpi-viewer>', (element) => {
      Object.assign(element, { room: 'attic', token: 'secret' });
    });
    const request = await until(() => asked.find((one) => new URL(one.url()).pathname === '/v1/live/attic'));
    assert.equal((await request.allHeaders()).authorization, 'Bearer secret');
    await context.close();
  });

  test('an element whose photo is named late shows it, and the newest of several', async () => {
    const { page, context, errors } = await early('<tmpi-viewer></tmpi-viewer>');
    const element = page.locator('tmpi-viewer');
    // what tells it that it is in sight has told it
    await frames(page, 3);
    // the modules of the viewer are not there yet when it is told another
    await element.evaluate((e) => e.setAttribute('src', '/nowhere'));
    await element.evaluate((e) => e.setAttribute('src', '/v1/photos/box/atlas'));
    await loaded(page);
    assert.match(await element.evaluate((e) => e.viewer.options.atlas), /box\/atlas$/);
    // far below, it waits until it is told not to
    await element.evaluate((e) => {
      e.remove();
      e.style.marginTop = '5000px';
      e.removeAttribute('src');
      document.body.append(e);
    });
    await frames(page, 3);
    await element.evaluate((e) => e.setAttribute('src', '/v1/photos/box/atlas'));
    await frames(page, 5);
    assert.equal(await element.evaluate((e) => e.viewer), null);
    await element.evaluate((e) => e.setAttribute('loading', 'eager'));
    await loaded(page);
    assert.ok(await element.evaluate((e) => e.viewer.asleep), 'nobody sees it');
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('its name follows what the page calls it', async () => {
    const { page, context } = await early('<tmpi-viewer src="/nowhere" loading="eager" alt=""></tmpi-viewer>');
    const alert = page.getByRole('alert');
    await alert.waitFor();
    const name = (attribute, value) =>
      page
        .locator('tmpi-viewer')
        .evaluate((element, [a, v]) => (v === null ? element.removeAttribute(a) : element.setAttribute(a, v)), [attribute, value]);
    assert.equal(await named(page), '3D photo');
    for (const [attribute, value, wanted] of [
      ['title', 'By its title', 'By its title'],
      ['alt', 'By its text', 'By its text'],
      ['aria-label', 'By its label', 'By its label'],
      ['alt', 'By another text', 'By its label'],
      ['aria-label', null, 'By another text'],
    ]) {
      await name(attribute, value);
      assert.equal(await named(page), wanted);
      assert.ok((await alert.textContent()).includes(wanted), 'in place of the photo, too');
    }
    await context.close();
  });
});

// Many elements on a page, and changes to running elements.
import assert from 'node:assert/strict';
import { after, before, describe, test } from 'node:test';
import { launch, MOTION, openPage } from '../support/browser.mjs';
import { boxContainer } from '../support/container.mjs';
import { serve } from '../support/fake-server.mjs';
import { boxSuite } from '../support/suite.mjs';

/** More than the 16 WebGL contexts that Chromium allows per page. */
const MANY = 24;
const element = (more = '') => `<tmpi-viewer src="/v1/photos/box/atlas" alt="A box" ${more}></tmpi-viewer>`;

/** Opens a page with this HTML. */
async function open(browser, server, html, options = {}) {
  const opened = await openPage(browser, options);
  await opened.page.goto(`${server.url}/embed/blank`);
  await opened.page.evaluate((markup) => (document.body.innerHTML = markup), html);
  await opened.page.addScriptTag({ type: 'module', url: '/tmpi-viewer.js' });
  return opened;
}

/** Collects the warnings of Chromium that it takes a context away because the page has too many. */
function takenAway(page) {
  const warnings = [];
  page.on('console', (message) => /too many active webgl/i.test(message.text()) && warnings.push(message.text()));
  return warnings;
}

describe('many elements without WebGPU', () => {
  let server;
  let browser;
  before(async () => {
    server = await serve({ atlas: boxContainer() });
    browser = await launch({ webgpu: false });
  });
  after(async () => {
    await browser?.close();
    await server?.close();
  });

  const modes = (page) => page.evaluate(() => [...document.querySelectorAll('tmpi-viewer')].map((e) => e.viewer?.mode));
  const drawn = (page, n) => page.waitForFunction((i) => document.querySelectorAll('tmpi-viewer')[i].viewer?.mode === 'webgl', n);

  test(`each of ${MANY} is drawn whenever it is scrolled into view`, async () => {
    const { page, context, errors } = await open(
      browser,
      server,
      `<style>tmpi-viewer { width: 150px; margin-bottom: 700px }</style>${element('loading="eager"').repeat(MANY)}`,
    );
    const warnings = takenAway(page);
    const visit = async (n) => {
      await page.evaluate((i) => document.querySelectorAll('tmpi-viewer')[i].scrollIntoView(), n);
      await drawn(page, n);
    };
    // the first have lost their contexts by then; each visit takes another one's
    for (let n = 0; n < MANY + 6; n++) await visit(n % MANY);
    await visit(0);
    assert.deepEqual(warnings, []);
    assert.ok(
      (await modes(page)).every((mode) => mode === 'webgl' || mode === 'loading'),
      'no element falls back to the server',
    );
    // elements without a context show the photo
    const pictured = await page.evaluate(() =>
      [...document.querySelectorAll('tmpi-viewer')].map((e) => e.shadowRoot.querySelector('.tmpi-poster').naturalWidth),
    );
    assert.deepEqual(new Set(pictured), new Set([200]));
    assert.deepEqual(errors, []);
    await context.close();
  });

  test(`with ${MANY} visible, the element in use is drawn`, async () => {
    const { page, context, errors } = await open(
      browser,
      server,
      `<style>body { margin: 0 } tmpi-viewer { width: 100px; height: 60px; display: inline-block }</style>${element().repeat(MANY)}`,
    );
    const warnings = takenAway(page);
    await page.waitForFunction(
      (n) => [...document.querySelectorAll('tmpi-viewer')].filter((e) => e.viewer?.mode === 'webgl').length >= n,
      12,
    );
    await page.waitForFunction(() =>
      [...document.querySelectorAll('tmpi-viewer')].every((e) => e.shadowRoot.querySelector('.tmpi-poster')?.naturalWidth),
    );
    const earlier = await modes(page);
    const waiting = earlier.indexOf('loading');
    assert.ok(waiting >= 0, 'some elements wait for a context');
    await page.locator('tmpi-viewer').nth(waiting).hover();
    await drawn(page, waiting);
    const later = await modes(page);
    assert.equal(earlier.filter((mode, n) => mode === 'webgl' && later[n] !== mode).length, 1, 'one makes room for it');
    // removed elements free contexts for waiting ones
    await page.evaluate(() => {
      for (const e of [...document.querySelectorAll('tmpi-viewer')].slice(0, 12)) e.remove();
    });
    await page.waitForFunction(() => [...document.querySelectorAll('tmpi-viewer')].every((e) => e.viewer.mode === 'webgl'));
    assert.deepEqual(
      errors.filter((e) => /context/i.test(e)),
      [],
    );
    assert.deepEqual(warnings, []);
    await context.close();
  });
});

describe('a running element', () => {
  const suite = boxSuite();
  const running = async (html) => {
    const opened = await open(suite.browser, suite.server, `<style>tmpi-viewer { width: 300px }</style>${html}`, MOTION);
    await opened.page.waitForFunction(() => document.querySelector('tmpi-viewer').loaded);
    return opened;
  };
  const idle = (page) => page.evaluate(() => document.querySelector('tmpi-viewer').viewer.idle);

  test('follows changes of reduced motion', async () => {
    const { page, context } = await running(element());
    assert.equal(await idle(page), true);
    await page.emulateMedia({ reducedMotion: 'reduce' });
    await page.waitForFunction(() => !document.querySelector('tmpi-viewer').viewer.idle);
    await page.emulateMedia({ reducedMotion: 'no-preference' });
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer.idle);
    await context.close();
  });

  test('accepts "false" and properties, as frameworks set them', async () => {
    const { page, context } = await running(
      element('auto-rotate="false" camera-controls="false" fullscreen="false" settings="false" still="false"'),
    );
    const state = () =>
      page.evaluate(() => {
        const e = document.querySelector('tmpi-viewer');
        const button = e.shadowRoot.querySelector('button').hidden;
        return [e.viewer.idle, e.shadowRoot.querySelector('.stage').inert, button, e.autoRotate, e.cameraControls, e.fullscreen, e.still];
      });
    assert.deepEqual(await state(), [false, true, true, false, false, false, false]);
    const requests = await page.evaluate(() => performance.getEntriesByType('resource').filter((r) => r.name.endsWith('/settings')).length);
    assert.equal(requests, 0);
    // React 19 sets a property if the element has one with the attribute's name
    await page.evaluate(() => {
      const e = document.querySelector('tmpi-viewer');
      for (const name of ['auto-rotate', 'camera-controls', 'fullscreen']) if (name in e) e[name] = true;
    });
    assert.deepEqual(await state(), [true, false, false, true, true, true, false]);
    await page.evaluate(() => (document.querySelector('tmpi-viewer').still = true));
    assert.deepEqual((await state())[0], false);
    await page.evaluate(() => (document.querySelector('tmpi-viewer')['auto-rotate'] = false));
    await page.evaluate(() => (document.querySelector('tmpi-viewer').still = false));
    assert.deepEqual((await state()).slice(0, 4), [false, false, false, false]);
    await context.close();
  });

  test('moves within the page without a restart', async () => {
    const { page, context } = await running(`<div id="there"></div>${element('still')}`);
    const same = await page.evaluate(() => {
      const e = document.querySelector('tmpi-viewer');
      const { viewer } = e;
      const there = document.getElementById('there');
      if (!there.moveBefore) return null;
      there.moveBefore(e, null);
      return e.viewer === viewer && !viewer.disposed && e.parentElement === there;
    });
    assert.equal(same, true);
    await context.close();
  });
});

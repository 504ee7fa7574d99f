// The element in React, Vue and Svelte, with the components of docs/guides/embedding.md.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { describe, test } from 'node:test';
import { MOTION, openPage } from '../support/browser.mjs';
import { FRAMEWORKS, routeFramework } from '../support/frameworks.mjs';
import { boxSuite } from '../support/suite.mjs';
import { until } from '../support/until.mjs';

const GUIDE = readFileSync(new URL('../../../docs/guides/embedding.md', import.meta.url), 'utf8');
const SCRIPT = '<script type="module" src="/tmpi-viewer.js"></script>';

/** The guide's component for a framework: the first block of code under its name. */
function component(name) {
  const section = GUIDE.split(`\n### ${name}\n`)[1];
  assert.ok(section, `the guide has a part on ${name}`);
  const [block] = section.match(/(?:^(?: {4}.*)?\n)+/m);
  return block.trim().replace(/^ {4}/gm, '');
}

describe('frameworks', () => {
  const suite = boxSuite();
  const SRC = '/v1/photos/box/atlas';

  const harnesses = {};
  /** The framework's harness; compilers are slow, so each runs once. */
  const harnessOf = (name) => (harnesses[name] ??= FRAMEWORKS[name](component(name.split(' ')[0])));

  /** Opens a page of the framework; `late`: the element's script comes after the program's. */
  async function open(name, { late = false, webgpu = true } = {}) {
    const opened = await openPage(suite.browser, MOTION);
    const { page } = opened;
    const workers = [];
    page.on('worker', (worker) => workers.push(worker));
    if (!webgpu) await page.addInitScript(() => Object.defineProperty(navigator, 'gpu', { value: undefined }));
    await routeFramework(page, harnessOf(name), late ? '' : SCRIPT);
    await page.goto(`${suite.server.url}/framework`);
    await page.waitForFunction(() => window.show);
    return { ...opened, workers };
  }
  const show = (page, all) => page.evaluate((photos) => window.show(photos), all);
  const loaded = (page, count) =>
    page.waitForFunction((n) => {
      const all = [...document.querySelectorAll('tmpi-viewer')];
      return all.length === n && all.every((e) => e.loaded);
    }, count);
  const idle = (page) => page.evaluate(() => [...document.querySelectorAll('tmpi-viewer')].map((e) => e.viewer.idle));

  for (const name of Object.keys(FRAMEWORKS)) {
    test(`${name} sets attributes, sorts without a restart, and frees what it removes`, async () => {
      const { page, context, errors, workers } = await open(name, { webgpu: name !== 'Vue' });
      await show(page, [{ src: SRC, alt: 'a', moves: false }]);
      await loaded(page, 1);
      assert.deepEqual(await idle(page), [false]);
      assert.equal(await page.evaluate(() => window.loads), 1, 'the event arrives');
      assert.equal(await page.locator('tmpi-viewer').getAttribute('alt'), 'a');
      for (const moves of [true, 'off', null, false]) {
        await show(page, [{ src: SRC, alt: 'a', moves }]);
        const on = moves !== false && moves !== 'off' && !(moves === null && name === 'Vue');
        assert.deepEqual(await idle(page), [on], `${moves}`);
      }
      // a list without a restart
      const photos = ['a', 'b', 'c'].map((alt) => ({ src: SRC, alt, moves: false }));
      await show(page, photos);
      await loaded(page, 3);
      await page.evaluate(
        () => (window.before = Object.fromEntries([...document.querySelectorAll('tmpi-viewer')].map((e) => [e.alt, e.viewer]))),
      );
      await show(page, photos.toReversed());
      const kept = await page.evaluate(() =>
        [...document.querySelectorAll('tmpi-viewer')].map((e) => [e.alt, e.viewer === window.before[e.alt] && e.loaded]),
      );
      assert.deepEqual(kept, [
        ['c', true],
        ['b', true],
        ['a', true],
      ]);
      await page.evaluate(() => Promise.resolve());
      assert.deepEqual(await page.evaluate(() => Object.values(window.before).map((viewer) => viewer.disposed)), [false, false, false]);
      await page.evaluate(() => {
        const { renderer } = window.before.a;
        if (renderer.device) renderer.device.lost.then(() => (window.lost = true));
        else window.lost = false;
      });
      await page.evaluate(() => window.end());
      assert.equal(await page.locator('tmpi-viewer').count(), 0);
      await page.waitForFunction(() => Object.values(window.before).every((viewer) => viewer.disposed));
      // the last element takes the device or its context along
      await page.waitForFunction(() => window.lost || Object.values(window.before).every(({ renderer }) => renderer.gl?.isContextLost()));
      await until(() => workers.every((worker) => !page.workers().includes(worker)));
      assert.ok(workers.length >= 3, `${workers.length} workers`);
      assert.deepEqual(errors, []);
      await context.close();
    });

    test(`${name} may draw before the element’s script has run`, async () => {
      const { page, context, errors } = await open(name, { late: true });
      // React 19 leaves out an attribute that is false, as the guide says
      await show(page, [{ src: SRC, alt: 'a', moves: name === 'React 19' ? 'off' : false }]);
      await page.addScriptTag({ type: 'module', url: '/tmpi-viewer.js' });
      await loaded(page, 1);
      assert.deepEqual(await idle(page), [false]);
      await show(page, [{ src: SRC, alt: 'a', moves: true }]);
      assert.deepEqual(await idle(page), [true]);
      assert.deepEqual(errors, []);
      await context.close();
    });
  }

  test('an element that is removed while it loads stops its decoder', async () => {
    const { page, context } = await open('React 19');
    let release;
    suite.server.held.atlas = new Promise((resume) => (release = resume));
    try {
      await show(page, [{ src: SRC, alt: 'a' }]);
      await until(() => page.workers().length === 1);
      await page.evaluate(() => window.end());
      await until(() => page.workers().length === 0);
    } finally {
      release();
      suite.server.held.atlas = undefined;
    }
    await context.close();
  });

  test('an element keeps its scene under another parent, and follows what changed meanwhile', async () => {
    const { page, context } = await open('React 19');
    await page.evaluate((src) => {
      document.body.insertAdjacentHTML('beforeend', `<div id="there"></div><tmpi-viewer src="${src}" alt="a"></tmpi-viewer>`);
    }, SRC);
    await loaded(page, 1);
    const move = (change) =>
      page.evaluate(async (attributes) => {
        const e = document.querySelector('tmpi-viewer');
        const { viewer } = e;
        e.remove();
        for (const [name, value] of Object.entries(attributes)) e.setAttribute(name, value);
        document.getElementById('there').append(e);
        await Promise.resolve();
        return [e.viewer === viewer, viewer.disposed, e.viewer?.idle];
      }, change);
    assert.deepEqual(await move({}), [true, false, true]);
    assert.deepEqual(await move({ still: '' }), [true, false, false]);
    const [same, disposed] = await move({ src: `${SRC}?another` });
    assert.deepEqual([same, disposed], [false, true], 'another photo');
    await loaded(page, 1);
    await context.close();
  });

  test('the sound of a room can be set as a property, which React does', async () => {
    const { page, context, errors } = await open('React 19');
    const sound = await page.evaluate(() => {
      const e = document.createElement('tmpi-viewer');
      e.sound = 'off';
      const off = e.getAttribute('sound');
      e.sound = true;
      return [off, e.getAttribute('sound'), e.sound];
    });
    assert.deepEqual(sound, ['off', '', false]);
    assert.deepEqual(errors, []);
    await context.close();
  });
});

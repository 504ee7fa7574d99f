// Layout of the element: shape, fit, full screen, poster and error.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, seriousViolations } from '../support/browser.mjs';
import { serve } from '../support/fake-server.mjs';
import { boxSuite, HEIGHT, WIDTH } from '../support/suite.mjs';

describe('layout of the element', () => {
  const suite = boxSuite();
  /** Opens a page of another site with the element. */
  async function open(more = 'still', within = '', host = suite.server.url) {
    const other = await serve({ atlas: Buffer.alloc(0) });
    const opened = await openPage(suite.browser);
    await opened.page.goto(`${other.url}/embed?${new URLSearchParams({ host, more, in: within })}`);
    const close = async () => {
      await opened.context.close();
      await other.close();
    };
    return { ...opened, close };
  }
  const drawn = (page) => page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer?.mode === 'gpu');
  const box = (page, selector) =>
    page.evaluate((s) => {
      const element = document.querySelector('tmpi-viewer');
      const { x, y, width, height } = (s ? element.shadowRoot.querySelector(s) : element).getBoundingClientRect();
      return { x, y, width, height };
    }, selector);
  const near = (a, b, what) => assert.ok(Math.abs(a - b) < 1.5, `${what}: ${a}, not ${b}`);

  test('has the photo’s shape, or the shape that CSS sets', async () => {
    const { page, errors, close } = await open();
    await drawn(page);
    const own = await box(page);
    near(own.height, (own.width * HEIGHT) / WIDTH, 'height');
    near((await box(page, 'canvas')).width, own.width, 'the canvas fills the element');
    await page.addStyleTag({ content: 'tmpi-viewer { aspect-ratio: 1; width: 300px }' });
    near((await box(page)).height, 300, 'height by CSS');
    assert.deepEqual(errors, []);
    await close();
  });

  test('a poster sets the shape before the photo loads', async () => {
    const picture = `${suite.server.url}/v1/photos/box/view?w=60&h=90`;
    for (const [more, within] of [
      ['reveal="interaction"', `<img slot="poster" src="${picture}" alt="">`],
      [`reveal="interaction" poster="${picture}"`, ''],
    ]) {
      const { page, close } = await open(more, within);
      await page.waitForFunction(() => {
        const { width, height } = document.querySelector('tmpi-viewer').getBoundingClientRect();
        return Math.abs(height - width * 1.5) < 2;
      });
      assert.equal(await page.evaluate(() => document.querySelector('tmpi-viewer').viewer), null);
      const seen = await page.evaluate(() => {
        const host = document.querySelector('tmpi-viewer');
        return (host.querySelector('img') ?? host.shadowRoot.querySelector('.poster')).getBoundingClientRect().height;
      });
      near(seen, (await box(page)).height, 'the poster fills the element');
      // the photo replaces the poster
      await page.evaluate(() => document.querySelector('tmpi-viewer').setAttribute('loading', 'eager'));
      await page.locator('tmpi-viewer').hover();
      await drawn(page);
      await page.waitForFunction(() => document.querySelector('tmpi-viewer').shadowRoot.querySelector('slot[name=poster]').hidden);
      await close();
    }
  });

  test('fit="cover" fills the element and crops the photo', async () => {
    const { page, close } = await open('still fit="cover" style="aspect-ratio: 1; width: 400px"');
    await drawn(page);
    const [host, canvas] = [await box(page), await box(page, 'canvas')];
    near(canvas.height, 400, 'height');
    near(canvas.width, (400 * WIDTH) / HEIGHT, 'width');
    near(canvas.x + canvas.width / 2, host.x + 200, 'middle');
    near(canvas.y, host.y, 'top');
    // a wide element crops the height
    await page.evaluate(() => (document.querySelector('tmpi-viewer').style.aspectRatio = '4'));
    await page.waitForFunction(() => {
      const { width, height } = document.querySelector('tmpi-viewer').shadowRoot.querySelector('canvas').getBoundingClientRect();
      return Math.abs(width - 400) < 1.5 && Math.abs(height - 240) < 1.5;
    });
    await page.evaluate(() => document.querySelector('tmpi-viewer').setAttribute('fit', 'contain'));
    await page.waitForFunction(
      () => document.querySelector('tmpi-viewer').shadowRoot.querySelector('canvas').getBoundingClientRect().height < 101,
    );
    await close();
  });

  test('the button enters full screen', async () => {
    const { page, errors, close } = await open();
    await drawn(page);
    const button = page.getByRole('button', { name: 'Full screen' });
    await button.focus();
    await page.keyboard.press('Enter');
    await page.waitForFunction(() => document.fullscreenElement?.localName === 'tmpi-viewer');
    const wide = await box(page);
    near(wide.width, await page.evaluate(() => innerWidth), 'width');
    near(wide.height, await page.evaluate(() => innerHeight), 'height');
    await page.evaluate(() => document.exitFullscreen());
    await page.waitForFunction(() => !document.fullscreenElement);
    await page.evaluate(() => document.querySelector('tmpi-viewer').setAttribute('fullscreen', 'off'));
    assert.ok(await button.isHidden());
    assert.deepEqual(errors, []);
    await close();
  });

  test('a missing photo shows its text, the error, or the slot', async () => {
    const missing = `${suite.server.url}/nowhere`;
    const { page, close } = await open('loading="eager"', '', missing);
    await page.evaluate(() => {
      window.moved = 0;
      document.querySelector('tmpi-viewer').addEventListener('camera-change', () => window.moved++);
    });
    await page.addScriptTag({ type: 'module', url: `${suite.server.url}/tmpi-viewer.js` });
    const alert = page.getByRole('alert');
    await alert.getByText('A box before a wall').waitFor();
    assert.equal(await page.evaluate(() => window.moved), 0, 'the camera does not move without a photo');
    assert.match(await alert.textContent(), /there is no \/nowhere/i);
    assert.ok((await box(page)).height > 100);
    assert.deepEqual(
      (await seriousViolations(page)).filter((v) => v.includes('tmpi-viewer')),
      [],
    );
    await page.evaluate(
      (address) => document.querySelector('tmpi-viewer').setAttribute('src', address),
      `${suite.server.url}/v1/photos/box/atlas`,
    );
    await drawn(page);
    assert.ok(await alert.isHidden(), 'another photo replaces the error');
    await close();

    const own = await open('loading="eager"', '<a slot="error" href="/elsewhere">Gone fishing</a>', missing);
    await own.page.addScriptTag({ type: 'module', url: `${suite.server.url}/tmpi-viewer.js` });
    await own.page.getByRole('link', { name: 'Gone fishing' }).waitFor();
    assert.ok(await own.page.getByText('A box before a wall').isHidden());
    await own.close();
  });
});

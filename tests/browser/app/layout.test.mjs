// Important controls are on the screen and large enough.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, waitForMode } from '../support/browser.mjs';
import { roomSuite } from '../support/room.mjs';
import { boxSuite } from '../support/suite.mjs';

const DESKTOP = { viewport: { width: 1280, height: 800 } };
const PHONE = { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true };
const PHONE_LANDSCAPE = { viewport: { width: 844, height: 390 }, hasTouch: true, isMobile: true };

/** Edges of an element, and size of the screen. */
const bounds = (locator) =>
  locator.evaluate((element) => {
    const { left, top, right, bottom } = element.getBoundingClientRect();
    return { left, top, right, bottom, width: innerWidth, height: innerHeight };
  });

async function assertOnScreen(locator, what) {
  const at = await bounds(locator);
  assert.ok(at.left >= 0 && at.top >= 0 && at.right <= at.width && at.bottom <= at.height, `${what}: ${JSON.stringify(at)}`);
}

describe('the photo page', () => {
  const suite = boxSuite();
  async function open(options) {
    suite.server.state.settings = { version: 1 };
    const opened = await suite.open(options);
    await waitForMode(opened.page, 'gpu');
    return opened;
  }

  test('a desktop shows all settings and a long dialog’s buttons', async () => {
    const { page, context } = await open(DESKTOP);
    await page.locator('#settings').click();
    await assertOnScreen(page.locator('#set-title'), 'first setting');
    await assertOnScreen(page.locator('#delete'), 'last setting');
    await page.keyboard.press('Escape');
    await page.locator('#share').click();
    await page.locator('#share-embed').click();
    const dialog = page.getByRole('dialog', { name: 'Put it on a page' });
    await dialog.waitFor();
    for (const name of ['Copy: In a frame', 'Copy: As an element', 'Close'])
      await assertOnScreen(dialog.getByRole('button', { name }), name);
    const [download, close] = [dialog.getByRole('link', { name: 'Download' }), dialog.getByRole('button', { name: 'Close' })];
    assert.ok((await bounds(download)).bottom <= (await bounds(close)).top, 'nothing covers the link');
    await context.close();
  });

  test('keeps the photo visible above a menu on a phone', async () => {
    const { page, context } = await open(PHONE);
    await page.locator('#share').click();
    const [frame, menu] = [await bounds(page.locator('#frame')), await bounds(page.locator('#share-menu'))];
    assert.ok(menu.top >= frame.bottom - 1 && menu.top - frame.bottom < 80, JSON.stringify([frame, menu]));
    await context.close();
  });

  test('touch-up shows a large photo on a landscape phone', async () => {
    const { page, context } = await open(PHONE_LANDSCAPE);
    await page.locator('#settings').click();
    await page.locator('#touch-up').click();
    const canvas = page.locator('#touch-photo');
    await canvas.waitFor();
    const { left, top, right, bottom, width, height } = await bounds(canvas);
    assert.ok((right - left) / width > 0.25 || (bottom - top) / height > 0.6, JSON.stringify({ left, top, right, bottom }));
    for (const id of ['touch-cancel', 'touch-save']) {
      await page.locator(`#${id}`).scrollIntoViewIfNeeded();
      await assertOnScreen(page.locator(`#${id}`), id);
    }
    await context.close();
  });
});

describe('other pages', () => {
  const suite = roomSuite();
  test('the embedded page shows a readable error', async () => {
    const { page, context } = await openPage(suite.browser, DESKTOP);
    await page.goto(`${suite.server.url}/embed/${'0'.repeat(32)}`);
    const reason = page.locator('tmpi-viewer .reason');
    await reason.waitFor();
    const { brightness, button } = await reason.evaluate((line) => {
      const { color, opacity } = getComputedStyle(line);
      const [r, g, b] = color.match(/[\d.]+/g).map(Number);
      const fullscreen = line.getRootNode().querySelector('button');
      return { brightness: Math.min(r, g, b) * Number(opacity), button: getComputedStyle(fullscreen).display };
    });
    assert.ok(brightness > 150, `${brightness} of 255, on black`);
    assert.equal(button, 'none', 'no full-screen button without a photo');
    await context.close();
  });

  for (const [screen, options] of Object.entries({ 'a desktop': DESKTOP, 'a phone': PHONE })) {
    test(`the publisher’s page shows the next step on ${screen}`, async () => {
      const room = screen.replace(' ', '-');
      const { page, context } = await suite.publish(room, { options, loaded: (page) => assertOnScreen(page.locator('#go'), 'Start') });
      await page.locator('#link').waitFor();
      for (const id of ['preview', 'stop', 'link', 'copy']) await assertOnScreen(page.locator(`#${id}`), id);
      await context.close();
    });
  }
});

// What people need is on the screen, and as large as they need it.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, waitForMode } from '../support/browser.mjs';
import { roomSuite } from '../support/room.mjs';
import { boxSuite, STILL } from '../support/suite.mjs';

const DESKTOP = { viewport: { width: 1280, height: 800 } };
const PHONE = { viewport: { width: 390, height: 844 }, hasTouch: true, isMobile: true };
const PHONE_ON_ITS_SIDE = { viewport: { width: 844, height: 390 }, hasTouch: true, isMobile: true };

/** Where an element is: its edges, and the screen's size. */
const place = (locator) =>
  locator.evaluate((element) => {
    const { left, top, right, bottom } = element.getBoundingClientRect();
    return { left, top, right, bottom, width: innerWidth, height: innerHeight };
  });

async function onScreen(locator, what) {
  const at = await place(locator);
  assert.ok(at.left >= 0 && at.top >= 0 && at.right <= at.width && at.bottom <= at.height, `${what}: ${JSON.stringify(at)}`);
}

describe('the page of a photo', () => {
  const suite = boxSuite();
  async function open(options) {
    suite.server.state.settings = { version: 1 };
    const opened = await suite.open({ ...STILL, ...options });
    await waitForMode(opened.page, 'gpu');
    return opened;
  }

  test('has all settings on a desktop at once', async () => {
    const { page, context } = await open(DESKTOP);
    await page.locator('#settings').click();
    await onScreen(page.locator('#set-title'), 'the first');
    await onScreen(page.locator('#delete'), 'the last');
    await context.close();
  });

  test('leaves the photo what a short menu does not need on a phone', async () => {
    const { page, context } = await open(PHONE);
    await page.locator('#share').click();
    const [frame, menu] = [await place(page.locator('#frame')), await place(page.locator('#share-menu'))];
    assert.ok(menu.top >= frame.bottom - 1 && menu.top - frame.bottom < 80, JSON.stringify([frame, menu]));
    await context.close();
  });

  test('shows the photo that is touched up as large as a phone on its side allows', async () => {
    const { page, context } = await open(PHONE_ON_ITS_SIDE);
    await page.locator('#settings').click();
    await page.locator('#touch-up').click();
    const canvas = page.locator('#touch-photo');
    await canvas.waitFor();
    const { left, top, right, bottom, width, height } = await place(canvas);
    assert.ok((right - left) / width > 0.25 || (bottom - top) / height > 0.6, JSON.stringify({ left, top, right, bottom }));
    for (const id of ['touch-cancel', 'touch-save']) {
      await page.locator(`#${id}`).scrollIntoViewIfNeeded();
      await onScreen(page.locator(`#${id}`), id);
    }
    await context.close();
  });

  test('has the way out of a long dialog, and what it offers, in sight', async () => {
    const { page, context } = await open(DESKTOP);
    await page.locator('#share').click();
    await page.locator('#share-embed').click();
    const dialog = page.getByRole('dialog', { name: 'Put it on a page' });
    await dialog.waitFor();
    for (const name of ['Copy: In a frame', 'Copy: As an element', 'Close']) await onScreen(dialog.getByRole('button', { name }), name);
    const [download, close] = [dialog.getByRole('link', { name: 'Download' }), dialog.getByRole('button', { name: 'Close' })];
    assert.ok((await place(download)).bottom <= (await place(close)).top, 'nothing lies over it');
    await context.close();
  });
});

describe('the page', () => {
  const suite = roomSuite();
  test('of a photo in a frame says readably that there is none', async () => {
    const { page, context } = await openPage(suite.browser, DESKTOP);
    await page.goto(`${suite.server.url}/embed/${'0'.repeat(32)}`);
    const reason = page.locator('tmpi-viewer .reason');
    await reason.waitFor();
    const { light, button } = await reason.evaluate((line) => {
      const { color, opacity } = getComputedStyle(line);
      const [r, g, b] = color.match(/[\d.]+/g).map(Number);
      const full = line.getRootNode().querySelector('button');
      return { light: Math.min(r, g, b) * Number(opacity), button: getComputedStyle(full).display };
    });
    assert.ok(light > 150, `${light} of 255, on black`);
    assert.equal(button, 'none', 'nothing to fill the screen with');
    await context.close();
  });

  for (const [screen, options] of Object.entries({ 'a desktop': DESKTOP, 'a phone': PHONE })) {
    test(`of who publishes has what comes next on ${screen} in sight`, async () => {
      const room = screen.replace(' ', '-');
      const before = await openPage(suite.camera, { ...options, permissions: ['camera', 'microphone'] });
      await before.page.goto(`${suite.server.url}/live/${room}/publish`);
      await onScreen(before.page.locator('#go'), 'Start');
      await before.context.close();
      const { page, context } = await suite.publish(room, { options });
      await page.locator('#link').waitFor();
      for (const id of ['preview', 'stop', 'link', 'copy']) await onScreen(page.locator(`#${id}`), id);
      await context.close();
    });
  }
});

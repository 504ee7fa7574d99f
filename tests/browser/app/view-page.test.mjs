// Texts and dialogs of the photo page.
import assert from 'node:assert/strict';
import { before, describe, test } from 'node:test';
import { MOTION, waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

const PHONE = { hasTouch: true, isMobile: true, viewport: { width: 390, height: 844 } };

describe('the photo page', () => {
  const suite = boxSuite();
  /** A page with the owner's menus; each test closes what it opens. */
  let page;
  before(async () => {
    suite.server.state.settings = { version: 1, title: 'The box' };
    ({ page } = await suite.open());
    await waitForMode(page, 'gpu');
  });

  test('names motions the same in settings and films', async () => {
    const texts = (selector) => page.locator(`${selector} option`).allTextContents();
    const set = (await texts('#set-idle')).filter((text) => text !== 'Not at all');
    await page.locator('#share').click();
    await page.locator('#share-film').click();
    const dialog = page.getByRole('dialog', { name: 'A film or GIF' });
    await dialog.waitFor();
    const film = await dialog.getByLabel('Movement').locator('option').allTextContents();
    assert.deepEqual(film, [...set, 'Wigglegram']);
    const [make, close] = await Promise.all(['Make it', 'Close'].map((name) => dialog.getByRole('button', { name }).boundingBox()));
    assert.equal(make.y, close.y, 'the buttons are side by side');
    await dialog.getByRole('button', { name: 'Close' }).click();
    await dialog.waitFor({ state: 'detached' });
  });

  test('stops idle motion while the user sets the blur', async () => {
    const { page, context } = await suite.open(MOTION);
    await waitForMode(page, 'gpu');
    assert.ok(await page.evaluate(() => window.viewer.idle));
    await page.locator('#show').click();
    await page.locator('#blur').fill('0.5');
    assert.ok(await page.evaluate(() => !window.viewer.idle && window.viewer.blur === 0.5));
    await context.close();
  });

  for (const [device, seen, other] of [
    ['a mouse', 'Click the picture', 'Tap the picture'],
    ['fingers', 'Tap the picture', 'Click the picture'],
  ]) {
    test(`explains how to use it with ${device}`, async () => {
      const phone = device === 'fingers' ? await suite.open(PHONE) : null;
      const { page: shown } = phone ?? { page };
      await waitForMode(shown, 'gpu');
      const note = await shown.locator('#served-note').textContent();
      assert.equal(/scroll|double-click/.test(note), device === 'a mouse', note);
      assert.equal(/pinch|tap/.test(note), device === 'fingers', note);
      await shown.locator('#show').click();
      await shown.locator('#blur').fill('0.5');
      assert.ok(await shown.getByText(seen).isVisible());
      assert.ok(await shown.getByText(other).isHidden());
      await shown.locator('#blur').fill('0');
      await shown.keyboard.press('Escape');
      await phone?.context.close();
    });
  }

  test('keeps the title centred beside a long readout', async () => {
    await page.waitForFunction(() => document.title.startsWith('The box'));
    const middle = () =>
      page.evaluate(() => {
        // in the same task, before the page writes its own
        document.getElementById('readout').textContent = '250 % · drawn by the server';
        const range = document.createRange();
        range.selectNodeContents(document.getElementById('title'));
        const { left, right } = range.getBoundingClientRect();
        return (left + right) / 2 - innerWidth / 2;
      });
    assert.ok(Math.abs(await middle()) < 2, `${await middle()}`);
  });

  test('explains how to paint as near as another place', async () => {
    await page.locator('#settings').click();
    await page.locator('#touch-up').click();
    await page.getByLabel('As near as a place').check();
    await page.getByText('First paint over what is at the wrong depth').waitFor();
    const save = page.locator('#touch-save');
    assert.ok(await save.isDisabled());
    // WCAG 2.2, 1.4.3: also readable when disabled
    const contrast = await save.evaluate((button) => {
      const { color, backgroundColor } = getComputedStyle(button);
      const luminance = (text) => {
        const [r, g, b] = text
          .match(/[\d.]+/g)
          .slice(0, 3)
          .map((v) => (v / 255 <= 0.03928 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4));
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
      };
      const [a, b] = [luminance(color), luminance(backgroundColor)].toSorted((x, y) => y - x);
      return (a + 0.05) / (b + 0.05);
    });
    assert.ok(contrast >= 4.5, `${contrast}`);
    await page.locator('#touch-cancel').click();
    await page.locator('dialog.touch-up').waitFor({ state: 'detached' });
  });

  test('asks before unsaved settings are lost', async () => {
    await page.locator('#settings').click();
    await page.locator('#set-title').fill('Another');
    await page.keyboard.press('Escape');
    await page.getByText('Not saved yet').waitFor();
    const question = page.waitForEvent('dialog');
    const leaving = page.evaluate(() => location.assign('/')).catch(() => {});
    const dialog = await question;
    assert.equal(dialog.type(), 'beforeunload');
    await dialog.dismiss();
    await leaving;
    await page.locator('#settings').click();
    await page.locator('#set-save').click();
    await page.getByText('Saved', { exact: true }).waitFor();
    let askedAgain = false;
    page.on('dialog', (other) => {
      askedAgain = true;
      other.accept();
    });
    await page.goto(`${suite.server.url}/embed/blank`);
    assert.equal(askedAgain, false);
  });
});

// What the page of a photo says and asks.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

const PHONE = { reducedMotion: 'reduce', hasTouch: true, isMobile: true, viewport: { width: 390, height: 844 } };

describe('the page of a photo', () => {
  const suite = boxSuite();

  test('calls each motion the same in settings and films', async () => {
    suite.server.state.settings = { version: 1 };
    const { page, context } = await suite.open();
    await waitForMode(page, 'gpu');
    const texts = (selector) => page.locator(`${selector} option`).allTextContents();
    const set = (await texts('#set-idle')).filter((text) => text !== 'Not at all');
    await page.locator('#share').click();
    await page.locator('#share-film').click();
    const dialog = page.getByRole('dialog', { name: 'A film or GIF' });
    await dialog.waitFor();
    const film = await dialog.getByLabel('Movement').locator('option').allTextContents();
    assert.deepEqual(film, [...set, 'Wigglegram']);
    const [make, close] = await Promise.all(['Make it', 'Close'].map((name) => dialog.getByRole('button', { name }).boundingBox()));
    assert.equal(make.y, close.y, 'side by side');
    await context.close();
    suite.server.state.settings = undefined;
  });

  test('asks before settings are lost that are not saved', async () => {
    suite.server.state.settings = { version: 1 };
    const { page, context } = await suite.open();
    await waitForMode(page, 'gpu');
    await page.locator('#settings').click();
    await page.locator('#set-title').fill('Another');
    await page.keyboard.press('Escape');
    await page.getByText('Not saved yet').waitFor();
    const asked = page.waitForEvent('dialog');
    const left = page.evaluate(() => location.assign('/')).catch(() => {});
    const dialog = await asked;
    assert.equal(dialog.type(), 'beforeunload');
    await dialog.dismiss();
    await left;
    await page.locator('#settings').click();
    await page.locator('#set-save').click();
    await page.getByText('Saved', { exact: true }).waitFor();
    let again = false;
    page.on('dialog', (other) => {
      again = true;
      other.accept();
    });
    await page.goto(`${suite.server.url}/embed/blank`);
    assert.equal(again, false);
    await context.close();
    suite.server.state.settings = undefined;
  });

  test('stands still while its blur is set', async () => {
    const { page, context } = await suite.open({});
    await waitForMode(page, 'gpu');
    assert.ok(await page.evaluate(() => window.viewer.idle));
    await page.locator('#show').click();
    await page.locator('#blur').fill('0.5');
    assert.ok(await page.evaluate(() => !window.viewer.idle && window.viewer.blur === 0.5));
    await context.close();
  });

  for (const [device, options, seen, other] of [
    ['a mouse', { reducedMotion: 'reduce' }, 'Click the picture', 'Tap the picture'],
    ['fingers', PHONE, 'Tap the picture', 'Click the picture'],
  ]) {
    test(`tells whoever has ${device} what to do with them`, async () => {
      const { page, context } = await suite.open(options);
      await waitForMode(page, 'gpu');
      const note = await page.locator('#served-note').textContent();
      assert.equal(/scroll|double-click/.test(note), device === 'a mouse', note);
      assert.equal(/pinch|tap/.test(note), device === 'fingers', note);
      await page.locator('#show').click();
      await page.locator('#blur').fill('0.5');
      assert.ok(await page.getByText(seen).isVisible());
      assert.ok(await page.getByText(other).isHidden());
      await context.close();
    });
  }

  test('has its title in the middle, however long the readout', async () => {
    suite.server.state.settings = { version: 1, title: 'The box' };
    const { page, context } = await suite.open();
    await page.waitForFunction(() => document.title.startsWith('The box'));
    const middle = () =>
      page.evaluate(() => {
        const range = document.createRange();
        range.selectNodeContents(document.getElementById('title'));
        const { left, right } = range.getBoundingClientRect();
        return (left + right) / 2 - innerWidth / 2;
      });
    await page.evaluate(() => (document.getElementById('readout').textContent = '250 % · drawn by the server'));
    assert.ok(Math.abs(await middle()) < 2, `${await middle()}`);
    await context.close();
    suite.server.state.settings = undefined;
  });

  test('says first what to do where something is to be as near as a place', async () => {
    suite.server.state.settings = { version: 1 };
    const { page, context } = await suite.open();
    await waitForMode(page, 'gpu');
    await page.locator('#settings').click();
    await page.locator('#touch-up').click();
    await page.getByLabel('As near as a place').check();
    await page.getByText('First paint over what is at the wrong depth').waitFor();
    const save = page.locator('#touch-save');
    assert.ok(await save.isDisabled());
    // WCAG 2.2, 1.4.3: readable, also where it cannot be pressed
    const contrast = await save.evaluate((button) => {
      const { color, backgroundColor } = getComputedStyle(button);
      const light = (text) => {
        const [r, g, b] = text
          .match(/[\d.]+/g)
          .slice(0, 3)
          .map((v) => (v / 255 <= 0.03928 ? v / 255 / 12.92 : ((v / 255 + 0.055) / 1.055) ** 2.4));
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
      };
      const [a, b] = [light(color), light(backgroundColor)].toSorted((x, y) => y - x);
      return (a + 0.05) / (b + 0.05);
    });
    assert.ok(contrast >= 4.5, `${contrast}`);
    await context.close();
    suite.server.state.settings = undefined;
  });
});

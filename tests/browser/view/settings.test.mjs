// The owner's settings of a photo.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, seriousViolations, waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';
import { waitForStill } from '../support/until.mjs';

describe('settings', () => {
  const suite = boxSuite();

  test('settings apply, can be changed and are saved', async () => {
    const { page, context, errors } = await openPage(suite.browser);
    suite.server.state.settings = {
      version: 1,
      title: 'The box',
      motion: { x: 0.5, y: 1, z: 1 },
      start: { x: 0.5, y: 0, z: 0 },
      focus: 0.6,
    };
    await page.goto(`${suite.server.url}/view/box`);
    await waitForMode(page, 'gpu');
    assert.equal(await page.locator('#title').textContent(), 'The box');
    // the limit, and the start, is half the view box of 0.03 to the right
    await page.waitForFunction(() => Math.abs(window.viewer.pose.tx - 0.015) < 1e-3);
    assert.equal(await page.evaluate(() => window.viewer.pivot), 0.6);
    await page.locator('#stage').focus();
    for (let i = 0; i < 20; i++) await page.keyboard.press('ArrowRight');
    await waitForStill(page);
    assert.ok((await page.evaluate(() => window.viewer.pose.tx)) <= 0.015);
    await page.locator('#settings').click();
    assert.deepEqual(await seriousViolations(page), []);
    await page.getByLabel('Title').fill('Another box');
    await page.getByLabel('How far it moves').fill('1');
    await page.getByRole('button', { name: 'Save with the photo' }).click();
    await page.getByText('Saved', { exact: true }).waitFor();
    assert.equal(await page.locator('#title').textContent(), 'Another box');
    const [{ headers, body }] = suite.server.patches;
    assert.equal(headers['if-match'], '"1"');
    assert.deepEqual(JSON.parse(body), { title: 'Another box', motion: null });
    assert.ok(await page.evaluate(() => window.viewer.limits.x > 0.029));
    assert.deepEqual(errors, []);
    await context.close();
    suite.server.state.settings = undefined;
  });
});

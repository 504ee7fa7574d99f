// Deletions, and how they are taken back.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { photo, uploadSuite } from '../support/upload-page.mjs';

describe('undo', () => {
  const suite = uploadSuite();

  test('a photo deleted while its row is shown takes the row with it', async () => {
    const one = { ...photo('a'), settings: { version: 1, title: 'one' } };
    const { page, context } = await suite.open({ pages: [{ photos: [one] }], posts: [{ status: 202, json: one }] });
    await page.route('**/v1/photos/a', (route) => route.fulfill({ status: 204 }));
    await page.setInputFiles('#picker', { name: 'one.png', mimeType: 'image/png', buffer: Buffer.from('x') });
    await page.getByRole('link', { name: 'Open one.png' }).waitFor();
    await page.getByRole('button', { name: 'Delete one' }).click();
    await page.locator('.upload').waitFor({ state: 'detached' });
    assert.ok(await page.locator('#uploads').isHidden());
    await context.close();
  });

  test('a deletion can be undone; leaving the page carries it out', async () => {
    const { page, context } = await suite.open({ pages: [{ photos: [photo('a'), photo('b')] }] });
    const cards = page.locator('.card:visible');
    await cards.nth(1).waitFor();
    await cards.first().getByRole('button').click();
    assert.equal(await cards.count(), 1);
    await page.getByRole('button', { name: 'Undo' }).click();
    assert.equal(await cards.count(), 2);
    assert.deepEqual(suite.server.deleted, []);
    await cards.first().getByRole('button').click();
    await page.goto('about:blank');
    for (let i = 0; i < 50 && !suite.server.deleted.length; i++) await page.waitForTimeout(100);
    assert.deepEqual(suite.server.deleted, ['/v1/photos/a']);
    await context.close();
  });
});

// Deleting photos, and undo.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { until } from '../support/until.mjs';
import { photo, uploadSuite } from '../support/upload-page.mjs';

describe('delete later', () => {
  const suite = uploadSuite();

  test('deleting a photo removes its upload row', async () => {
    const one = { ...photo('a'), settings: { version: 1, title: 'one' } };
    const { page, context } = await suite.open({ pages: [{ photos: [one] }], posts: [{ status: 202, json: one }] });
    await page.route('**/v1/photos/a', (route) => route.fulfill({ status: 204 }));
    await page.setInputFiles('#picker', { name: 'one.png', mimeType: 'image/png', buffer: Buffer.from('x') });
    await page.getByRole('link', { name: 'Open one.png' }).waitFor();
    // hover keeps the row from closing by itself
    await page.getByRole('link', { name: 'Open one.png' }).hover();
    await page.getByRole('button', { name: 'Delete one' }).dispatchEvent('click');
    await page.locator('.upload').waitFor({ state: 'detached' });
    assert.ok(await page.locator('#uploads').isHidden());
    await context.close();
  });

  test('undo restores all; leaving the page deletes', async () => {
    const { page, context } = await suite.open({ pages: [{ photos: [photo('a'), photo('b'), photo('c')] }] });
    const cards = page.locator('.card:visible');
    await cards.nth(2).waitFor();
    await cards.first().getByRole('button').click();
    await page.locator('.undo').getByText('deleted').waitFor();
    await cards.first().getByRole('button').click();
    await page.getByText('2 photos deleted').waitFor();
    assert.equal(await cards.count(), 1);
    await page.getByRole('button', { name: 'Undo' }).click();
    assert.equal(await cards.count(), 3);
    assert.equal(await page.locator('.undo').count(), 0);
    assert.deepEqual(suite.server.deleted, []);
    await cards.first().getByRole('button').click();
    await cards.first().getByRole('button').click();
    await page.goto('about:blank');
    await until(() => suite.server.deleted.length === 2);
    assert.deepEqual(suite.server.deleted.toSorted(), ['/v1/photos/a', '/v1/photos/b']);
    await context.close();
  });

  test('the gallery can undo a deletion from the photo page', async () => {
    suite.server.deleted.length = 0;
    const { page, context } = await suite.open({ pages: [{ photos: [photo('a'), photo('b')] }] });
    await page.locator('.card').nth(1).waitFor();
    const hand = (id) => page.evaluate((i) => import('/static/app/delete-later.js').then((m) => m.handOver(i, 'The one')), id);
    await Promise.all([page.waitForEvent('load'), hand('b')]);
    await page.getByRole('button', { name: 'Undo' }).waitFor();
    assert.equal(await page.locator('.card:visible').count(), 1);
    await page.getByRole('button', { name: 'Undo' }).click();
    assert.equal(await page.locator('.card:visible').count(), 2);
    // the offer appears once
    await page.reload();
    await page.locator('.card').nth(1).waitFor();
    assert.equal(await page.locator('.undo').count(), 0);
    // a photo that is not on the first page of the gallery
    await Promise.all([page.waitForEvent('load'), hand('z')]);
    await page.getByText('The one deleted').waitFor();
    await page.goto('about:blank');
    await until(() => suite.server.deleted.length);
    assert.deepEqual(suite.server.deleted, ['/v1/photos/z'], 'undo prevents the deletion');
    await context.close();
  });
});

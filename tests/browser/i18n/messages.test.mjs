// The second language.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { photo, uploadSuite } from '../support/upload-page.mjs';

describe('messages', () => {
  const suite = uploadSuite();

  test('the page speaks German where the browser does', async () => {
    const { page, context } = await suite.open({ pages: [{ photos: [photo('a')] }], options: { locale: 'de-DE' } });
    await page.getByText('Fotos auswählen', { exact: true }).first().waitFor();
    await page.getByRole('button', { name: /löschen$/ }).waitFor();
    assert.equal(await page.locator('html').getAttribute('lang'), 'de');
    const english = await page.evaluate(() => document.body.innerText.match(/\b(Drop|Choose|Options|Photos|Undo|removed)\b/g));
    assert.equal(english, null);
    await context.close();
  });
});

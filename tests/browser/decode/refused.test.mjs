// A page whose policy forbids WebAssembly.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

describe('where WebAssembly is forbidden', () => {
  const suite = boxSuite({ webgpu: false, wasm: false });

  test('the photo is shown, then the server’s views; the console names the word that is missing', async () => {
    const { page, context, errors } = await suite.open();
    await waitForMode(page, 'served');
    // it is asked for within the next frames
    for (let i = 0; i < 50 && suite.server.views.length === 0; i++) await page.waitForTimeout(100);
    assert.ok(suite.server.views.length > 0, 'no view was asked for');
    assert.ok(
      errors.some((text) => text.includes("'wasm-unsafe-eval'")),
      errors.join('; '),
    );
    await context.close();
  });
});

// A page whose policy forbids WebAssembly.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';
import { until } from '../support/until.mjs';

describe('where WebAssembly is forbidden', () => {
  const suite = boxSuite({ webgpu: false, wasm: false });

  test('the photo is shown, then the server’s views; the console names the word that is missing', async () => {
    const { page, context, errors } = await suite.open();
    await waitForMode(page, 'served');
    await until(() => suite.server.views.length > 0);
    assert.ok(
      errors.some((text) => text.includes("'wasm-unsafe-eval'")),
      errors.join('; '),
    );
    await context.close();
  });
});

// A page whose content security policy forbids WebAssembly.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';
import { until } from '../support/until.mjs';

describe('without WebAssembly', () => {
  const suite = boxSuite({ webgpu: false, wasm: false });

  test('the server draws, and the console names the missing keyword', async () => {
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

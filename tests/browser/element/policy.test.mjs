// The content security policy in docs/guides/embedding.md is sufficient for the element, and every source in it is necessary.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { describe, test } from 'node:test';
import { openPage } from '../support/browser.mjs';
import { serve } from '../support/fake-server.mjs';
import { boxSuite } from '../support/suite.mjs';
import { until } from '../support/until.mjs';

const PAGE = readFileSync(new URL('../../../docs/guides/embedding.md', import.meta.url), 'utf8');
const RECIPE = PAGE.match(/^ {4}Content-Security-Policy: (.*HOST.*)$/m)[1];

describe('content security policy', () => {
  const suite = boxSuite();

  /** Mode, poster width and errors of the element on a page with a policy. */
  async function under(policy) {
    const other = await serve({ atlas: Buffer.alloc(0) });
    const { page, context, errors } = await openPage(suite.browser);
    const host = suite.server.url;
    const poster = `still poster="${host}/v1/photos/box/view?w=20&h=12"`;
    await page.goto(`${other.url}/embed?${new URLSearchParams({ host, policy: policy.replaceAll('HOST', host), more: poster })}`);
    const relevant = () => errors.filter((e) => !e.includes('favicon') && !e.includes('data:,'));
    const state = () =>
      page.evaluate(() => {
        const { viewer, shadowRoot } = document.querySelector('tmpi-viewer');
        const poster = shadowRoot?.querySelector('.poster');
        return { mode: viewer?.mode ?? 'loading', done: Boolean(poster?.complete), picture: poster?.naturalWidth ?? 0 };
      });
    const { mode, picture } = await until(async () => {
      const { done, ...result } = await state();
      return (relevant().length || (result.mode !== 'loading' && done)) && result;
    });
    await context.close();
    await other.close();
    return { mode, picture, errors: relevant() };
  }

  test('is sufficient for WebGPU and the poster', async () => {
    assert.deepEqual(await under(`default-src 'none'; ${RECIPE}`), { mode: 'gpu', picture: 20, errors: [] });
  });

  test('needs every source except the worker’s', async () => {
    const words = RECIPE.split('; ').flatMap((directive) => {
      const [name, ...sources] = directive.split(' ');
      return sources.map((source) => ({ name, source }));
    });
    assert.ok(words.length >= 6, RECIPE);
    // without a worker source the main thread decodes
    const optional = ['worker-src'];
    for (const { name, source } of words) {
      const less = RECIPE.split('; ')
        .map((directive) =>
          directive.startsWith(`${name} `)
            ? directive
                .split(' ')
                .filter((word) => word !== source)
                .join(' ')
            : directive,
        )
        .join('; ');
      const { mode, picture, errors } = await under(`default-src 'none'; ${less}`);
      const missing = mode !== 'gpu' || picture !== 20 || errors.length > 0;
      assert.ok(missing || optional.includes(name), `${name} ${source} makes no difference`);
    }
  });
});

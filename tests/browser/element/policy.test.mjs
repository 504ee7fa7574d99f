// The content security policy that docs/guides/embedding.md tells is enough for the element, and no word of it is too many.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { describe, test } from 'node:test';
import { openPage } from '../support/browser.mjs';
import { serve } from '../support/static-server.mjs';
import { boxSuite, STILL } from '../support/suite.mjs';
import { until } from '../support/until.mjs';

const PAGE = readFileSync(new URL('../../../docs/guides/embedding.md', import.meta.url), 'utf8');
const RECIPE = PAGE.match(/^ {4}Content-Security-Policy: (.*HOST.*)$/m)[1];

describe('policy', () => {
  const suite = boxSuite();

  /** What the element comes to on a page with a policy: its mode and its poster's width, or what the policy is violated by first. */
  async function under(policy) {
    const other = await serve({ atlas: Buffer.alloc(0) });
    const { page, context, errors } = await openPage(suite.browser, STILL);
    const host = suite.server.url;
    const poster = `still poster="${host}/v1/photos/box/view?w=20&h=12"`;
    await page.goto(`${other.url}/embed?${new URLSearchParams({ host, policy: policy.replaceAll('HOST', host), more: poster })}`);
    const ours = () => errors.filter((e) => !e.includes('favicon') && !e.includes('data:,'));
    const seen = () =>
      page.evaluate(() => {
        const { viewer, shadowRoot } = document.querySelector('tmpi-viewer');
        const poster = shadowRoot?.querySelector('.poster');
        return { mode: viewer?.mode ?? 'loading', done: Boolean(poster?.complete), picture: poster?.naturalWidth ?? 0 };
      });
    const { mode, picture } = await until(async () => {
      const { done, ...told } = await seen();
      return (ours().length || (told.mode !== 'loading' && done)) && told;
    });
    await context.close();
    await other.close();
    return { mode, picture, errors: ours() };
  }

  test('with it the element draws in WebGPU and shows its poster', async () => {
    assert.deepEqual(await under(`default-src 'none'; ${RECIPE}`), { mode: 'gpu', picture: 20, errors: [] });
  });

  test('without any of its words something is missing', async () => {
    const words = RECIPE.split('; ').flatMap((directive) => {
      const [name, ...sources] = directive.split(' ');
      return sources.map((source) => ({ name, source }));
    });
    assert.ok(words.length >= 6, RECIPE);
    // without a worker's address the element decodes on the page's own thread
    const spared = ['worker-src'];
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
      assert.ok(missing || spared.includes(name), `${name} ${source} makes no difference`);
    }
  });
});

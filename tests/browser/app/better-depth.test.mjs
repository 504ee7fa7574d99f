// The offer of a better depth network, on a server that has one to fetch.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

const NAME = 'depth-anything-v2-small-fp16';
const WORSE = ['depth-anything-v2-metric', 'midas-v2.1', 'midas-v2.1-small', 'tmpi'];
const BETTER = { name: NAME, bytes: 49_642_442, licence: 'Apache-2.0' };

describe('better depth', () => {
  const suite = boxSuite();

  /**
   * The photo's page with a report that names `model` and a server whose network is in `states`, one after the other; to whom that is no affair it
   * has the network `name`.
   */
  async function opened(model, states, name) {
    const all = await suite.open();
    const { page } = all;
    await waitForMode(page, 'gpu');
    const asked = [];
    const report = { depth_model: model, stages: [{ name: 'depth', ms: 90 }], error: { tile_px: [] } };
    // as the server tells whoever may have the photo made again
    await page.route('**/v1/photos/box', (route) => {
      const known = states[0].better_than ? states[0] : { name, better_than: WORSE };
      const worse = known.better_than.some((kind) => report.depth_model.startsWith(kind));
      return route.fulfill({ json: { ...suite.server.state, ...(worse && { better_depth: known.name }) } });
    });
    await page.route('**/v1/photos/box/report*', (route) => route.fulfill({ json: report }));
    await page.route('**/v1/network', (route) => {
      asked.push(route.request().method());
      const [now] = states;
      if (states.length > 1) states.shift();
      return route.fulfill(typeof now === 'number' ? { status: now, json: { title: 'refused', status: now } } : { json: now });
    });
    await page.route('**/v1/photos/box/again', (route) => {
      asked.push('again');
      report.depth_model = states[0].name ?? name;
      return route.fulfill({ json: suite.server.state });
    });
    const menu = page.locator('#show-menu');
    await page.locator('#show').click();
    return { ...all, asked, menu };
  }

  test('it is fetched, and the photo is made again with it', async () => {
    const { context, errors, asked, menu } = await opened('tmpi', [
      { name: 'tmpi', better_than: [], better: BETTER },
      { name: 'tmpi', better_than: [], better: BETTER, fetched_bytes: 0 },
      { name: 'tmpi', better_than: [], better: BETTER, fetched_bytes: 24_821_221 },
      { name: NAME, better_than: WORSE },
    ]);
    await menu.getByRole('button', { name: 'Better depth: 50 MB, once' }).click();
    await menu.getByText('Fetching better depth: 25 MB of 50 MB').waitFor();
    assert.equal(await menu.getByRole('progressbar').getAttribute('value'), '0.5');
    await menu.getByRole('button', { name: 'Make again with Depth Anything V2 Small' }).click();
    await menu.getByText('estimated by Depth Anything V2 Small').waitFor();
    assert.equal(await menu.locator('#better-depth button').count(), 0);
    assert.deepEqual(asked.slice(0, 5), ['GET', 'POST', 'GET', 'GET', 'again']);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('a download that failed is told and can be tried again', async () => {
    const failed = { name: 'tmpi', better_than: [], better: BETTER, problem: 'the download broke off after 12 of 49642442 bytes' };
    const { context, menu } = await opened('tmpi', [failed]);
    await menu.getByText('The server could not fetch it.').click();
    await menu.getByText('the download broke off').waitFor();
    await menu.getByRole('button', { name: 'Better depth: 50 MB, once' }).waitFor();
    await context.close();
  });

  test('an owner whom the server’s networks are no affair of has the photo made again', async () => {
    const { context, asked, menu } = await opened('tmpi', [403], NAME);
    await menu.getByRole('button', { name: 'Make again with Depth Anything V2 Small' }).click();
    await menu.getByText('estimated by Depth Anything V2 Small').waitFor();
    assert.equal(await menu.locator('#better-depth > *').count(), 0);
    assert.deepEqual(asked.slice(0, 2), ['GET', 'again']);
    await context.close();
  });

  test('nothing is offered where no network estimated the depth, or one as good has, nor to strangers', async () => {
    for (const [model, count, now] of [
      ['given', 0, { name: NAME, better_than: WORSE }],
      [NAME, 1, { name: NAME, better_than: WORSE }],
      // the server has a worse one now
      [NAME, 1, { name: 'tmpi', better_than: [] }],
      ['moge-2-small', 1, { name: NAME, better_than: WORSE }],
      // whoever is refused has nothing to choose
      ['tmpi', 1, 401],
      ['tmpi', 1, 403],
    ]) {
      const { page, context, asked, menu } = await opened(model, [now]);
      await menu.locator('#depth-source').waitFor();
      await page.waitForTimeout(100);
      assert.equal(await menu.locator('#better-depth > *').count(), 0, model);
      assert.equal(asked.length, count, model);
      await context.close();
    }
  });
});

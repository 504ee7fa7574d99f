// The offer of a better depth network that the server can download.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';
import { until, waitForAnimationFrames } from '../support/until.mjs';

/** A small page: only its menu matters. */
const SMALL = { viewport: { width: 480, height: 560 } };
const NAME = 'depth-anything-v2-small-fp16';
const WORSE = ['depth-anything-v2-metric', 'midas-v2.1', 'midas-v2.1-small', 'tmpi'];
const BETTER = { name: NAME, bytes: 49_642_442, licence: 'Apache-2.0' };

describe('better depth', () => {
  const suite = boxSuite();

  /**
   * Opens the photo page, on `all` if that is given, with a report that names `model`; the server's network goes through `states`. Without access to
   * /v1/network, the network is `name`.
   */
  async function opened(model, states, name, all) {
    all ??= await openPage(suite.browser, SMALL);
    const { page } = all;
    await page.unrouteAll();
    await page.goto(`${suite.server.url}/view/box`);
    await waitForMode(page, 'gpu');
    const requests = [];
    const counts = { photos: 0 };
    const report = { depth_model: model, stages: [{ name: 'depth', ms: 90 }], input: {}, error: { tile_px: [] } };
    // the server sends better_depth to users who may make the photo again
    await page.route('**/v1/photos/box', (route) => {
      const known = states[0].better_than ? states[0] : { name, better_than: WORSE };
      counts.photos++;
      const worse = known.better_than.some((kind) => report.depth_model.startsWith(kind));
      return route.fulfill({ json: { ...suite.server.state, ...(worse && { better_depth: known.name }) } });
    });
    await page.route('**/v1/photos/box/report*', (route) => route.fulfill({ json: report }));
    await page.route('**/v1/network', (route) => {
      requests.push(route.request().method());
      const [now] = states;
      if (states.length > 1) states.shift();
      return route.fulfill(typeof now === 'number' ? { status: now, json: { title: 'refused', status: now } } : { json: now });
    });
    await page.route('**/v1/photos/box/remake', (route) => {
      requests.push('again');
      report.depth_model = states[0].name ?? name;
      return route.fulfill({ json: suite.server.state });
    });
    const menu = page.locator('#show-menu');
    await page.locator('#show').click();
    return { ...all, requests, counts, menu };
  }

  test('the page downloads it and makes the photo again', async () => {
    const { context, errors, requests, menu } = await opened('tmpi', [
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
    assert.deepEqual(requests.slice(0, 5), ['GET', 'POST', 'GET', 'GET', 'again']);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('the page reports a failed download and offers a retry', async () => {
    const failed = { name: 'tmpi', better_than: [], better: BETTER, problem: 'the download broke off after 12 of 49642442 bytes' };
    const { context, menu } = await opened('tmpi', [failed]);
    await menu.getByText('The server could not fetch it.').click();
    await menu.getByText('the download broke off').waitFor();
    await menu.getByRole('button', { name: 'Better depth: 50 MB, once' }).waitFor();
    await context.close();
  });

  test('an owner without access to networks makes the photo again', async () => {
    const { context, requests, menu } = await opened('tmpi', [403], NAME);
    await menu.getByRole('button', { name: 'Make again with Depth Anything V2 Small' }).click();
    await menu.getByText('estimated by Depth Anything V2 Small').waitFor();
    assert.equal(await menu.locator('#better-depth > *').count(), 0);
    assert.deepEqual(requests.slice(0, 2), ['GET', 'again']);
    await context.close();
  });

  test('no offer without a better network, or to strangers', async () => {
    const all = await openPage(suite.browser, SMALL);
    for (const [model, count, now] of [
      ['given', 0, { name: NAME, better_than: WORSE }],
      [NAME, 1, { name: NAME, better_than: WORSE }],
      // the server now has a worse network
      [NAME, 1, { name: 'tmpi', better_than: [] }],
      ['moge-2-small', 1, { name: NAME, better_than: WORSE }],
      // users without access get no choice
      ['tmpi', 1, 401],
      ['tmpi', 1, 403],
    ]) {
      const { page, requests, counts, menu } = await opened(model, [now], undefined, all);
      await menu.locator('#depth-source').waitFor();
      // the last response with the photo decides whether there is an offer
      await until(() => counts.photos >= count);
      await waitForAnimationFrames(page, 3);
      assert.equal(await menu.locator('#better-depth > *').count(), 0, model);
      assert.equal(requests.length, count, model);
    }
    await all.context.close();
  });
});

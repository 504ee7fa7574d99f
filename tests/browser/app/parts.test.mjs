// A large upload: it is sent in parts, and goes on by itself from what the server has.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage } from '../support/browser.mjs';
import { boxPhoto } from '../support/pictures.mjs';
import { startServer } from '../support/program.mjs';
import { photo, uploadSuite } from '../support/upload-page.mjs';

const UPLOAD = '/v1/uploads/u1';
const BYTES = 6 * 2 ** 20;
/** A photo of some megabytes: what is behind a PNG is no part of the picture. */
const large = Buffer.concat([boxPhoto(30, 20), Buffer.alloc(BYTES)]);

describe('a large upload', () => {
  const suite = uploadSuite();

  /** Opens the page and sends the photo; `parts` answers the parts one after the other, `state` is what the server has. */
  async function send(parts, state = () => ({})) {
    const begins = { status: 201, headers: { location: UPLOAD, 'upload-offset': '0', 'upload-complete': '?0' }, body: '' };
    const { page, context } = await suite.open({ pages: [{ photos: [] }] });
    const asked = [];
    await page.route('**/v1/photos', async (route) => {
      if (route.request().method() !== 'POST') return route.fallback();
      asked.push(['POST', await route.request().allHeaders()]);
      return route.fulfill(begins);
    });
    await page.route(`**${UPLOAD}`, async (route) => {
      const method = route.request().method();
      asked.push([method, await route.request().allHeaders()]);
      if (method === 'DELETE') return route.fulfill({ status: 204 });
      if (method === 'GET') return route.fulfill({ json: state() });
      return parts.shift()(route);
    });
    await page.setInputFiles('#picker', [{ name: 'large.png', mimeType: 'image/png', buffer: large }]);
    const of = (method) => asked.filter(([m]) => m === method).map(([, headers]) => headers);
    return { page, context, asked, of };
  }
  const row = (page, text) => page.locator('.upload', { hasText: text }).waitFor();
  const accepted = (route) => route.fulfill({ status: 202, json: { ...photo('p1'), state: 'queued' } });
  const lost = (route) => route.abort('connectionreset');

  test('goes on from what the server has where the connection was lost, and says so', async () => {
    const half = BYTES / 2;
    let gate;
    const shown = new Promise((resolve) => (gate = resolve));
    const last = async (route) => {
      await shown;
      return accepted(route);
    };
    const { page, context, of } = await send([lost, lost, last], () => ({ offset: half, complete: false }));
    await row(page, 'The connection was lost at 0 %; trying again in 1 s');
    await row(page, 'The connection was lost at 49 %');
    gate();
    await row(page, 'ready').catch(() => {});
    await page.waitForFunction(() => !document.querySelector('.upload')?.textContent.includes('lost'));
    const [begun] = of('POST');
    assert.equal(begun['upload-complete'], '?0');
    assert.match(begun['content-type'], /^multipart\/form-data; boundary=/);
    const whole = Number(begun['upload-length']);
    assert.ok(whole > large.length && whole < large.length + 1000, `${whole}`);
    const parts = of('PATCH');
    assert.deepEqual(
      parts.map((headers) => [headers['upload-offset'], headers['upload-complete'], headers['content-type']]),
      ['0', `${half}`, `${half}`].map((offset) => [offset, '?1', 'application/partial-upload']),
    );
    await context.close();
  });

  test('is told of the photo where the answer alone was lost', async () => {
    const { page, context, of } = await send([lost], () => ({ offset: BYTES, complete: true, photo: '/v1/photos/p1' }));
    await page.route('**/v1/photos/p1', (route) => route.fulfill({ json: { ...photo('p1'), state: 'queued' } }));
    await page.waitForFunction(() => document.querySelector('.upload')?.textContent.includes('lost'));
    await page.waitForFunction(() => !document.querySelector('.upload')?.textContent.includes('lost'));
    assert.equal(of('PATCH').length, 1);
    await context.close();
  });

  test('waits while the server is busy, and gives up what it is refused', async () => {
    const problem =
      (status, detail, headers = {}) =>
      (route) =>
        route.fulfill({ status, headers, contentType: 'application/problem+json', json: { status, detail, title: 'No' } });
    const busy = problem(429, 'as many photos are waiting', { 'retry-after': '1' });
    const { page, context, of } = await send([busy, problem(422, 'the picture is damaged')], () => ({ offset: BYTES, complete: false }));
    await row(page, 'The server is busy; trying again in 1 s');
    await row(page, 'the picture is damaged');
    assert.deepEqual(
      of('PATCH').map((headers) => headers['upload-offset']),
      ['0', `${BYTES}`],
    );
    await context.close();
  });

  test('goes at once where the server takes no parts', async () => {
    const { page, context, sent } = await suite.open({
      posts: [
        { status: 501, contentType: 'application/problem+json', json: { status: 501, title: 'No', detail: 'at once' } },
        { status: 202, json: { ...photo('p1'), state: 'queued' } },
      ],
    });
    await page.setInputFiles('#picker', [{ name: 'large.png', mimeType: 'image/png', buffer: large }]);
    while (sent.length < 2) await page.waitForTimeout(50);
    await page.locator('.upload a, .upload.done, #gallery .card').first().waitFor();
    await context.close();
  });

  test('that is cancelled is given up at the server, too', async () => {
    const { page, context, asked, of } = await send([() => {}]);
    while (!of('PATCH').length) await page.waitForTimeout(50);
    await page
      .getByRole('button', { name: /^Cancel/ })
      .first()
      .click();
    await page.locator('#uploads').waitFor({ state: 'hidden' });
    while (!of('DELETE').length) await page.waitForTimeout(50);
    assert.deepEqual(
      asked.map(([method]) => method),
      ['POST', 'PATCH', 'DELETE'],
    );
    await context.close();
  });

  test('is taken by the program itself, also where the connection is lost on its way', async () => {
    const server = await startServer();
    try {
      const { page, context } = await openPage(suite.browser);
      await page.goto(`${server.url}/`);
      let parts = 0;
      await page.route('**/v1/uploads/*', (route) => {
        const cut = route.request().method() === 'PATCH' && !parts++;
        return cut ? route.abort('connectionreset') : route.continue();
      });
      await page.setInputFiles('#picker', [{ name: 'large.png', mimeType: 'image/png', buffer: large }]);
      await page.locator('#gallery .card').first().waitFor();
      assert.equal(parts, 2);
      const { photos } = await (await fetch(`${server.url}/v1/photos`)).json();
      assert.deepEqual(
        photos.map((made) => [made.photo_bytes, made.settings.title]),
        [[large.length, 'large']],
      );
      await context.close();
    } finally {
      await server.close();
    }
  });
});

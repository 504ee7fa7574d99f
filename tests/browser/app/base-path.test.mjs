// The program at a path of its host, behind a proxy that serves another application beside it.
import assert from 'node:assert/strict';
import { createServer, request } from 'node:http';
import { after, before, describe, test } from 'node:test';
import { Tmpi } from '../../../npm/rest-client.js';
import { launch, openPage, waitForMode } from '../support/browser.mjs';
import { boxPhoto } from '../support/pictures.mjs';
import { startServer } from '../support/program.mjs';

describe('below a path', () => {
  let server;
  let browser;
  let proxy;
  let base;
  /** Requests for addresses that are not below the path. */
  const lost = [];
  before(async () => {
    server = await startServer(['--base-path', '/3d', '--access', 'private']);
    proxy = createServer((asked, answer) => {
      if (!asked.url.startsWith('/3d/')) {
        lost.push(asked.url);
        answer.writeHead(404).end();
        return;
      }
      const { method, headers } = asked;
      const passed = request(`${server.url}${asked.url}`, { method, headers: { ...headers, 'x-forwarded-for': '127.0.0.1' } }, (came) => {
        answer.writeHead(came.statusCode, came.headers);
        came.pipe(answer);
      });
      passed.on('error', () => answer.destroy());
      answer.on('close', () => passed.destroy());
      asked.pipe(passed);
    });
    await new Promise((resume) => proxy.listen(0, '127.0.0.1', resume));
    base = `http://127.0.0.1:${proxy.address().port}/3d`;
    browser = await launch();
  });
  after(async () => {
    await browser?.close();
    proxy?.closeAllConnections();
    proxy?.close();
    await server?.close();
  });

  test('uploads, shows, shares and deletes a photo', async () => {
    const { page, context, errors } = await openPage(browser);
    await page.goto(`${base}/`);
    await page.setInputFiles('#picker', { name: 'garden.png', mimeType: 'image/png', buffer: boxPhoto(320, 200) });
    await page.getByRole('link', { name: 'Open garden.png' }).click();
    await waitForMode(page, 'gpu');
    assert.match(page.url(), new RegExp(`^${base}/view/[0-9a-f]{32}$`));
    const id = page.url().split('/').pop();
    const cookies = await context.cookies(base);
    assert.deepEqual(
      cookies.map(({ name, path }) => [name, path]),
      [['tmpi_owner', '/3d']],
    );
    assert.deepEqual(await context.cookies(new URL('/', base).href), [], 'the other application gets none');
    await page.locator('#share').click();
    await page.locator('#share-access').click();
    const dialog = page.getByRole('dialog', { name: 'Who may see it' });
    const link = dialog.getByLabel('A link with an end date', { exact: true });
    await page.waitForFunction(() => document.querySelector('.share-dialog textarea')?.value.includes('signature='));
    const shared = await link.inputValue();
    assert.ok(shared.startsWith(`${base}/view/${id}?`), shared);
    await page.keyboard.press('Escape');
    await dialog.waitFor({ state: 'detached' });
    await page.locator('#share').click();
    await page.locator('#share-embed').click();
    const code = await page.getByLabel('As an element', { exact: true }).inputValue();
    assert.ok(code.includes(`src="${base}/tmpi-viewer.js"`) && code.includes(`src="${base}/v1/photos/${id}/atlas"`), code);
    const stranger = await openPage(browser);
    await stranger.page.goto(shared);
    await waitForMode(stranger.page, 'gpu');
    await stranger.page.goto(shared.replace('/view/', '/embed/'));
    await stranger.page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer?.mode === 'gpu');
    await stranger.context.close();
    await page.goto(`${base}/`);
    await page.getByRole('button', { name: 'Delete garden' }).click();
    await page.locator('#gallery .card').filter({ hasText: 'garden' }).waitFor({ state: 'detached' });
    assert.deepEqual([errors, stranger.errors, lost], [[], [], []]);
    await page.goto(`${base}/live/attic/publish`);
    // the server is private, and this owner has no link to publish
    await page.getByText('To go live here you need a link').waitFor();
    assert.equal(await page.getByLabel('Name of the room').inputValue(), 'attic');
    assert.deepEqual(lost, []);
    await context.close();
  });

  test('the client for JavaScript finds it', async () => {
    const tmpi = new Tmpi(base, { ownerLink: `${base}/#owner=tmpi_o_${'a'.repeat(40)}` });
    const made = await tmpi.upload(boxPhoto(64, 48), { wait: 30 });
    assert.equal(made.links.page, `/3d/view/${made.id}`);
    assert.equal(tmpi.address(made.links.page), `${base}/view/${made.id}`);
    await tmpi.wait(made.id);
    assert.equal(Buffer.from((await tmpi.atlas(made.id)).bytes).toString('latin1', 0, 4), 'TMPI');
    assert.deepEqual(lost, []);
  });
});

// A private photo in a frame on another site, where the browser sends no cookies; with the built program.
import assert from 'node:assert/strict';
import { createServer } from 'node:http';
import { after, before, describe, test } from 'node:test';
import { disableGraphics, launch, openPage } from '../support/browser.mjs';
import { boxDepth, boxPhoto } from '../support/pictures.mjs';
import { makePhoto, startServer } from '../support/program.mjs';

const HOST = 'photos.example';

describe('a frame on another site', () => {
  let server;
  let other;
  let browser;
  let photo;
  let link;
  before(async () => {
    server = await startServer(['--host', HOST]);
    // its own browser, which resolves another host name to the program
    browser = await launch({ webgpu: false, more: [`--host-resolver-rules=MAP ${HOST} 127.0.0.1`] });
    // the local user uploads the photo; the browser with another host name is a stranger
    photo = await makePhoto(server.url, boxPhoto(200, 120), boxDepth(200, 120));
    const headers = { 'content-type': 'application/merge-patch+json' };
    await fetch(`${server.url}${photo.links.self}`, { method: 'PATCH', headers, body: '{"title": "The box"}' });
    link = await (await fetch(`${server.url}${photo.links.self}/links?seconds=600`, { method: 'POST' })).json();
    other = createServer((request, response) => {
      const frame = new URL(request.url, 'http://localhost').searchParams.get('frame');
      response.writeHead(200, { 'content-type': 'text/html' });
      response.end(
        `<!doctype html><title>another site</title><link rel="icon" href="data:,"><iframe width="400" height="300" src="${frame}">`,
      );
    });
    await new Promise((resume) => other.listen(0, '127.0.0.1', resume));
  });
  after(async () => {
    await browser?.close();
    other?.close();
    await server?.close();
  });

  async function open(query, graphics) {
    const opened = await openPage(browser);
    if (!graphics) await disableGraphics(opened.page, { webgl: false });
    const requests = [];
    opened.page.on('request', (request) => {
      const { pathname, search } = new URL(request.url());
      if (pathname.startsWith('/v1/')) requests.push(pathname.split('/').pop() + search);
    });
    const frame = encodeURIComponent(`http://${HOST}:${new URL(server.url).port}/embed/${photo.id}${query}`);
    await opened.page.goto(`http://127.0.0.1:${other.address().port}/?frame=${frame}`);
    const embedded = opened.page.frames().find((f) => f.url().includes('/embed/'));
    return { ...opened, embedded, requests };
  }

  for (const graphics of [true, false]) {
    test(`shows the photo with a signed link, drawn by the ${graphics ? 'browser' : 'server'}`, async () => {
      const { embedded, requests, context } = await open(`?fit=cover&${link.query}`, graphics);
      await embedded.waitForFunction(() => document.getElementById('viewer').loaded);
      await embedded.waitForFunction(() => document.title === 'The box');
      assert.equal(await embedded.evaluate(() => document.getElementById('viewer').viewer.mode), graphics ? 'webgl' : 'served');
      assert.ok(
        requests.every((address) => address.includes(link.query)),
        `${requests}`,
      );
      for (const part of ['atlas', 'settings', graphics ? 'thumbnail' : 'view'])
        assert.ok(
          requests.some((address) => address.startsWith(part)),
          `${part}: ${requests}`,
        );
      await context.close();
    });
  }

  test('shows nothing without a link', async () => {
    const { embedded, context } = await open('', true);
    await embedded.waitForFunction(() => document.getElementById('viewer').shadowRoot.querySelector('.error:not([hidden])'));
    assert.notEqual(await embedded.title(), 'The box');
    await context.close();
  });
});

// A private photo in a frame on another site, where no cookie goes along, on the built program.
import assert from 'node:assert/strict';
import { createServer } from 'node:http';
import { after, before, describe, test } from 'node:test';
import { launch, openPage, takeGraphics } from '../support/browser.mjs';
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
    // one of its own, which finds the program by another name
    browser = await launch({ webgpu: false, more: [`--host-resolver-rules=MAP ${HOST} 127.0.0.1`] });
    // this machine's own user makes it; the browser comes under another name, as a stranger
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
    const opened = await openPage(browser, { reducedMotion: 'reduce' });
    if (!graphics) await takeGraphics(opened.page, { webgl: false });
    const asked = [];
    opened.page.on('request', (request) => {
      const { pathname, search } = new URL(request.url());
      if (pathname.startsWith('/v1/')) asked.push(pathname.split('/').pop() + search);
    });
    const frame = encodeURIComponent(`http://${HOST}:${new URL(server.url).port}/embed/${photo.id}${query}`);
    await opened.page.goto(`http://127.0.0.1:${other.address().port}/?frame=${frame}`);
    const shown = opened.page.frames().find((f) => f.url().includes('/embed/'));
    return { ...opened, shown, asked };
  }

  for (const graphics of [true, false]) {
    test(`shows it by its link, drawn by the ${graphics ? 'browser' : 'server'}`, async () => {
      const { shown, asked, context } = await open(`?fit=cover&${link.query}`, graphics);
      await shown.waitForFunction(() => document.getElementById('viewer').loaded);
      await shown.waitForFunction(() => document.title === 'The box');
      assert.equal(await shown.evaluate(() => document.getElementById('viewer').viewer.mode), graphics ? 'webgl' : 'served');
      assert.ok(
        asked.every((address) => address.includes(link.query)),
        `${asked}`,
      );
      for (const part of ['atlas', 'settings', graphics ? 'thumbnail' : 'view'])
        assert.ok(
          asked.some((address) => address.startsWith(part)),
          `${part}: ${asked}`,
        );
      await context.close();
    });
  }

  test('shows nothing of it without', async () => {
    const { shown, context } = await open('', true);
    await shown.waitForFunction(() => document.getElementById('viewer').shadowRoot.querySelector('.error:not([hidden])'));
    assert.notEqual(await shown.title(), 'The box');
    await context.close();
  });
});

// The element and its frame on restrictive pages: sandbox, Trusted Types, isolation, older browsers, forbidden workers.
import assert from 'node:assert/strict';
import { createServer } from 'node:http';
import { after, before, describe, test } from 'node:test';
import { fractionDifferent, launch, openPage } from '../support/browser.mjs';
import { boxContainer } from '../support/container.mjs';
import { boxDepth, boxPhoto } from '../support/pictures.mjs';
import { makePhoto, startServer } from '../support/program.mjs';

const [WIDTH, HEIGHT] = [200, 120];
const FRAME = 'width="400" height="240" style="border: 0"';

describe('restrictive pages', () => {
  let server;
  let browser;
  let photo;
  let pages;
  /** Responses of the page server by path: HTML and further headers. */
  const responses = new Map();
  before(async () => {
    server = await startServer();
    browser = await launch();
    photo = await makePhoto(server.url, boxPhoto(WIDTH, HEIGHT), boxDepth(WIDTH, HEIGHT));
    pages = createServer((request, response) => {
      if (request.url === '/box.tmpi') return response.end(boxContainer());
      const [html, headers] = responses.get(request.url) ?? ['', {}];
      response.writeHead(200, { 'content-type': 'text/html', ...headers });
      response.end(`<!doctype html><title>a page</title><link rel="icon" href="data:,">${html}`);
    });
    await new Promise((resume) => pages.listen(0, '127.0.0.1', resume));
  });
  after(async () => {
    await browser?.close();
    pages?.close();
    await server?.close();
  });

  /** Opens a page of another site. */
  async function open(html, { headers = {}, prepare = async () => {}, options = {}, on = browser } = {}) {
    const path = `/${responses.size}`;
    responses.set(path, [html, headers]);
    const opened = await openPage(on, options);
    const workers = [];
    opened.page.on('worker', (worker) => workers.push(worker.url()));
    await prepare(opened.page);
    await opened.page.goto(`http://127.0.0.1:${pages.address().port}${path}`);
    return { ...opened, workers };
  }
  const script = () => `<script type="module" src="${server.url}/tmpi-viewer.js"></script>`;
  const atlas = () => server.url + photo.links.atlas;
  const element = (more = '', src = atlas()) =>
    `${script()}<tmpi-viewer src="${src}" alt="A box" ${more} style="width: 400px"></tmpi-viewer>
     <script>window.messages = []; document.querySelector('tmpi-viewer').addEventListener('error', (e) => messages.push(e.detail.message));</script>`;

  /** Waits until the element on the page or in the frame shows something; returns its mode. */
  async function modeOf(page, frame = page.mainFrame()) {
    const mode = await frame.waitForFunction(() => {
      const { viewer, loaded } = document.querySelector('tmpi-viewer') ?? {};
      return loaded && viewer.mode !== 'loading' && viewer.mode;
    });
    return mode.jsonValue();
  }
  const frameOf = async (page) => (await page.waitForSelector('iframe')).contentFrame();
  const withoutFavicon = (errors) => errors.filter((e) => !/favicon/.test(e));

  /** Fraction of pixels that a moved camera changes; zero for a flat photo. */
  async function parallax(frame) {
    const at = (tx) =>
      frame.evaluate(async (x) => {
        const { viewer } = document.querySelector('tmpi-viewer');
        viewer.setPose({ tx: x });
        return [...(await viewer.readPixels(100, 60))];
      }, tx);
    return fractionDifferent(await at(0), await at(0.05), 100, 60);
  }

  test('a sandboxed frame shows the photo in 3D', async () => {
    const { page, context, errors } = await open(
      `<iframe sandbox="allow-scripts" src="${server.url}${photo.links.embed}" ${FRAME}></iframe>`,
    );
    const frame = await frameOf(page);
    assert.equal(await modeOf(page, frame), 'gpu');
    assert.ok((await parallax(frame)) > 0.05);
    assert.deepEqual(withoutFavicon(errors), []);
    await context.close();
  });

  for (const [name, sandbox] of [
    ['a srcdoc frame', ''],
    ['a sandboxed srcdoc frame', 'sandbox="allow-scripts"'],
  ]) {
    test(`${name} shows the element in 3D`, async () => {
      const inner = `<!doctype html><body>${element()}`.replaceAll('&', '&amp;').replaceAll('"', '&quot;');
      const { page, context, errors } = await open(`<iframe ${sandbox} srcdoc="${inner}" ${FRAME}></iframe>`);
      const frame = await frameOf(page);
      assert.equal(await modeOf(page, frame), 'gpu');
      assert.ok((await parallax(frame)) > 0.05);
      assert.deepEqual(withoutFavicon(errors), []);
      await context.close();
    });
  }

  for (const [name, policy] of [
    ['with any policy', "require-trusted-types-for 'script'"],
    ['with only the policy of the element', "require-trusted-types-for 'script'; trusted-types tmpi"],
  ]) {
    test(`Trusted Types ${name} allow decoding in a worker`, async () => {
      const { page, context, errors, workers } = await open(element(), { headers: { 'content-security-policy': policy } });
      assert.equal(await modeOf(page), 'gpu');
      assert.equal(workers.length, 1);
      assert.deepEqual(withoutFavicon(errors), []);
      await context.close();
    });
  }

  test('without workers the main thread decodes', async () => {
    for (const headers of [
      { 'content-security-policy': "worker-src 'none'" },
      { 'content-security-policy': "require-trusted-types-for 'script'; trusted-types other" },
    ]) {
      const { page, context, workers } = await open(element(), { headers });
      assert.equal(await modeOf(page), 'gpu', JSON.stringify(headers));
      assert.deepEqual(workers, []);
      assert.ok((await parallax(page.mainFrame())) > 0.05);
      await context.close();
    }
    const without = (page) => page.addInitScript(() => Reflect.deleteProperty(window, 'Worker'));
    const { page, context, errors } = await open(element(), { prepare: without });
    assert.equal(await modeOf(page), 'gpu');
    assert.deepEqual(withoutFavicon(errors), []);
    await context.close();
  });

  test('an isolated page shows the frame and the element', async () => {
    const headers = { 'cross-origin-embedder-policy': 'require-corp', 'cross-origin-opener-policy': 'same-origin' };
    const framed = await open(`<iframe src="${server.url}${photo.links.embed}" ${FRAME}></iframe>`, { headers });
    assert.equal(await framed.page.evaluate(() => crossOriginIsolated), true);
    assert.equal(await modeOf(framed.page, await frameOf(framed.page)), 'gpu');
    assert.deepEqual(withoutFavicon(framed.errors), []);
    await framed.context.close();
    const { page, context, errors } = await open(element(), { headers });
    assert.equal(await modeOf(page), 'gpu');
    assert.deepEqual(withoutFavicon(errors), []);
    await context.close();
  });

  test('works in browsers as old as Safari 16', async () => {
    const older = (page) =>
      page.addInitScript(() => {
        Reflect.deleteProperty(URL, 'canParse');
        Reflect.deleteProperty(Promise, 'withResolvers');
        // Safari before 16.4 has no constructable style sheets
        window.CSSStyleSheet = class {
          constructor() {
            throw new TypeError('Illegal constructor');
          }
        };
      });
    const { page, context, errors } = await open(element(), { prepare: older });
    assert.equal(await modeOf(page), 'gpu');
    const box = await page.locator('tmpi-viewer').boundingBox();
    assert.deepEqual([box.width, box.height], [400, 240], 'the element has the photo’s shape');
    assert.deepEqual(withoutFavicon(errors), []);
    await context.close();
  });

  test('a failure keeps the picture and fires an error event', async () => {
    const poster = `poster="${server.url}${photo.links.thumbnail}"`;
    const shown = (page) =>
      page.waitForFunction(() => {
        const { shadowRoot } = document.querySelector('tmpi-viewer');
        const rect = (e) => e?.checkVisibility() && e.naturalWidth > 0 && e.getBoundingClientRect().height > 0;
        return [...shadowRoot.querySelectorAll('img')].some(rect) && shadowRoot.querySelector('.error').hidden;
      });
    const abortViewer = (page) => page.route('**/static/view/viewer.js', (route) => route.abort());
    const failBeforePoster = async (page) => {
      await abortViewer(page);
      await page.route(`**${photo.links.thumbnail}`, async (route) => {
        await page.waitForFunction(() => window.messages?.length > 0);
        await route.continue();
      });
    };
    for (const [name, headers, prepare] of [
      ['without WebAssembly', { 'content-security-policy': `script-src 'unsafe-inline' ${server.url}; worker-src blob:` }, undefined],
      ['without the viewer', {}, abortViewer],
      ['before the poster has loaded', {}, failBeforePoster],
      ['without the container', {}, (page) => page.route('**/box.tmpi', (route) => route.fulfill({ status: 503, body: '' }))],
    ]) {
      const { page, context } = await open(element(poster, '/box.tmpi'), { headers, prepare });
      await page.waitForFunction(() => window.messages.length > 0);
      assert.ok((await page.evaluate(() => window.messages[0])).length > 8, name);
      await assert.doesNotReject(shown(page), `${name} the poster or the photo is visible`);
      await context.close();
    }
  });
});

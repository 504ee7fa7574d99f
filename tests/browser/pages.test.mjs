// The page of all photos, against answers of a server that the test makes up.
import assert from 'node:assert/strict';
import { after, before, describe, test } from 'node:test';
import { launch, openPage, seriousViolations } from './browser.mjs';
import { serve } from './static-server.mjs';

const photo = (id) => ({ id, state: 'done', created: '2026-03-04T05:06:07Z', width: 30, height: 20, atlas_bytes: 1500 });

describe('page of all photos', () => {
  let server;
  let browser;
  before(async () => {
    server = await serve({ atlas: Buffer.alloc(0) });
    browser = await launch({ webgpu: false });
  });
  after(async () => {
    await browser?.close();
    await server?.close();
  });

  /** Opens the page; `posts` gives the answers to uploads, one after the other. */
  async function open({ pages = [{ photos: [] }], posts = [], options = {} }) {
    const { page, context } = await openPage(browser, options);
    const sent = [];
    const bodies = [];
    await page.route('**/v1/photos*', (route) => {
      if (route.request().method() === 'POST') {
        sent.push(Date.now());
        bodies.push(route.request().postDataBuffer()?.toString('latin1') ?? '');
        return route.fulfill(posts.shift());
      }
      const after = Number(new URL(route.request().url()).searchParams.get('after') ?? 0);
      return route.fulfill({ json: pages[after] });
    });
    await page.route('**/v1/photos/*/events', (route) =>
      route.fulfill({ contentType: 'text/event-stream', body: 'event: stage\ndata: {"stage":"layers","step":3,"steps":4}\n\nevent: done\ndata: {}\n\n' }),
    );
    await page.goto(`${server.url}/`);
    return { page, context, sent, bodies };
  }

  test('an empty list says so; a long one goes on', async () => {
    const empty = await open({});
    await empty.page.getByText('No photo yet').waitFor();
    assert.ok(await empty.page.locator('#more').isHidden());
    await empty.context.close();
    const pages = [{ photos: [photo('a'), photo('b')], next: '/v1/photos?after=1' }, { photos: [photo('c')] }];
    const { page, context } = await open({ pages });
    await page.locator('#more').click();
    await page.locator('.card').nth(2).waitFor();
    assert.ok(await page.locator('#more').isHidden());
    await context.close();
  });

  test('where the server is busy the upload waits as long as it says', async () => {
    const posts = [
      { status: 429, headers: { 'retry-after': '1' }, contentType: 'application/problem+json', body: '{"detail":"64 photos wait"}' },
      { status: 202, json: { ...photo('a'), state: 'queued' } },
    ];
    const { page, context, sent } = await open({ posts });
    await page.setInputFiles('#picker', { name: 'one.png', mimeType: 'image/png', buffer: Buffer.from('x') });
    await page.getByText('trying again in 1 s').waitFor();
    await page.getByRole('link', { name: 'Open one.png' }).waitFor();
    assert.equal(sent.length, 2);
    assert.ok(sent[1] - sent[0] >= 950, `${sent[1] - sent[0]} ms`);
    await context.close();
  });

  test('photos can be dropped and pasted', async () => {
    const posts = [{ status: 202, json: photo('a') }, { status: 202, json: photo('b') }, { status: 202, json: photo('c') }];
    const { page, context, sent } = await open({ posts });
    await page.evaluate(() => {
      const files = new DataTransfer();
      for (const name of ['dropped.png', 'second.png']) files.items.add(new File(['x'], name, { type: 'image/png' }));
      const event = (type) => new DragEvent(type, { bubbles: true, cancelable: true, dataTransfer: files });
      document.body.dispatchEvent(event('dragenter'));
      if (!document.getElementById('drop').classList.contains('over')) throw new Error('the page does not show that it takes the files');
      document.body.dispatchEvent(event('drop'));
      const pasted = new DataTransfer();
      pasted.items.add(new File(['x'], 'pasted.png', { type: 'image/png' }));
      document.body.dispatchEvent(new ClipboardEvent('paste', { bubbles: true, cancelable: true, clipboardData: pasted }));
    });
    for (const name of ['dropped', 'second', 'pasted']) await page.getByRole('link', { name: `Open ${name}.png` }).waitFor();
    assert.equal(sent.length, 3);
    assert.ok(!(await page.locator('#drop').getAttribute('class')).includes('over'));
    await context.close();
  });

  test('a folder gives its pictures, those of folders in it too', async () => {
    const posts = [{ status: 202, json: photo('a') }, { status: 202, json: photo('b') }];
    const { page, context, sent } = await open({ posts });
    await page.evaluate(() => {
      const file = (name, type) => ({ isFile: true, file: (done) => done(new File(['x'], name, { type })) });
      // as browsers do, a reader gives a part at a time
      const folder = (...entries) => ({
        isDirectory: true,
        createReader: () => ({ readEntries: (done) => done(entries.splice(0, 2)) }),
      });
      const tree = folder(file('one.png', 'image/png'), file('notes.txt', 'text/plain'), folder(file('two.jpg', 'image/jpeg')));
      DataTransferItem.prototype.webkitGetAsEntry = () => tree;
      const files = new DataTransfer();
      files.items.add(new File([''], 'holiday'));
      document.body.dispatchEvent(new DragEvent('drop', { bubbles: true, cancelable: true, dataTransfer: files }));
    });
    for (const name of ['one.png', 'two.jpg']) await page.getByRole('link', { name: `Open ${name}` }).waitFor();
    assert.equal(sent.length, 2);
    await context.close();
  });

  test('a photo deleted while its row is shown takes the row with it', async () => {
    const { page, context } = await open({ pages: [{ photos: [photo('a')] }], posts: [{ status: 202, json: photo('a') }] });
    await page.route('**/v1/photos/a', (route) => route.fulfill({ status: 204 }));
    await page.setInputFiles('#picker', { name: 'one.png', mimeType: 'image/png', buffer: Buffer.from('x') });
    await page.getByRole('link', { name: 'Open one.png' }).waitFor();
    await page.getByRole('button', { name: 'Delete one' }).click();
    await page.locator('.upload').waitFor({ state: 'detached' });
    assert.ok(await page.locator('#uploads').isHidden());
    await context.close();
  });

  test('a deletion can be undone; leaving the page carries it out', async () => {
    const { page, context } = await open({ pages: [{ photos: [photo('a'), photo('b')] }] });
    const cards = page.locator('.card:visible');
    await cards.nth(1).waitFor();
    await cards.first().getByRole('button').click();
    assert.equal(await cards.count(), 1);
    await page.getByRole('button', { name: 'Undo' }).click();
    assert.equal(await cards.count(), 2);
    assert.deepEqual(server.deleted, []);
    await cards.first().getByRole('button').click();
    await page.goto('about:blank');
    for (let i = 0; i < 50 && !server.deleted.length; i++) await page.waitForTimeout(100);
    assert.deepEqual(server.deleted, ['/v1/photos/a']);
    await context.close();
  });

  test('a depth map goes with one photo', async () => {
    const posts = [{ status: 202, json: photo('a') }, { status: 202, json: photo('b') }];
    const { page, context, bodies } = await open({ posts });
    await page.locator('summary').click();
    await page.setInputFiles('#depth-map', { name: 'map.png', mimeType: 'image/png', buffer: Buffer.from('depths') });
    for (const name of ['one.png', 'two.png']) {
      await page.setInputFiles('#picker', { name, mimeType: 'image/png', buffer: Buffer.from('x') });
      await page.getByRole('link', { name: `Open ${name}` }).waitFor();
    }
    assert.match(bodies[0], /name="depth"; filename="map.png"/);
    assert.doesNotMatch(bodies[1], /name="depth"/);
    await context.close();
  });

  test('the page speaks German where the browser does', async () => {
    const { page, context } = await open({ pages: [{ photos: [photo('a')] }], options: { locale: 'de-DE' } });
    await page.getByText('Fotos auswählen').waitFor();
    await page.getByRole('button', { name: /löschen$/ }).waitFor();
    assert.equal(await page.locator('html').getAttribute('lang'), 'de');
    const english = await page.evaluate(() => document.body.innerText.match(/\b(Drop|Choose|Options|Photos|Undo|removed)\b/g));
    assert.equal(english, null);
    await context.close();
  });

  test('nothing stands in the way of people who do not see or point', async () => {
    for (const colorScheme of ['light', 'dark']) {
      const { page, context } = await open({ pages: [{ photos: [photo('a'), photo('b')] }], options: { colorScheme } });
      await page.locator('.card').nth(1).waitFor();
      await page.locator('summary').click();
      assert.deepEqual(await seriousViolations(page), []);
      await context.close();
    }
  });
});

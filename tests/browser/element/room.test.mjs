// Rooms in the element, on pages of this server and of others.
import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { randomBytes } from 'node:crypto';
import { writeFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { openPage, pixelsAt, shareDifferent } from '../support/browser.mjs';
import { program } from '../support/program.mjs';
import { likenessOf, roomSuite, SAME_DB, STILL, shoot } from '../support/room.mjs';
import { until } from '../support/until.mjs';
import { HEIGHT, WIDTH } from '../support/video.mjs';

describe('rooms in the element', () => {
  let key;
  const suite = roomSuite((folder) => {
    key = join(folder, 'key');
    writeFileSync(key, randomBytes(32));
    return ['--live-key', key];
  });
  const token = (room) => execFileSync(program, ['live', 'token', room, '--key', key], { encoding: 'utf8' }).trim();

  /** Somebody else's site, whose pages have an element with the attributes in the query. */
  let other;
  before(async () => {
    other = createServer((request, response) => {
      const asked = new URL(request.url, 'http://localhost').searchParams;
      response.writeHead(200, { 'content-type': 'text/html' });
      response.end(pageOf(asked.get('attributes') ?? ''));
    });
    await new Promise((resume) => other.listen(0, '127.0.0.1', resume));
  });
  after(() => {
    other.closeAllConnections();
    other.close();
  });

  const pageOf = (attributes) => `<!doctype html><title>a room</title><link rel="icon" href="data:,">
    <style>tmpi-viewer { width: 320px; height: 240px }</style>
    <script type="module" src="${suite.server.url}/tmpi-viewer.js"></script><tmpi-viewer ${attributes} alt="The attic"></tmpi-viewer>`;

  /** Opens a page with an element, on the site of the server itself or on another. */
  async function open(attributes, { own = false, options = STILL } = {}) {
    const opened = await openPage(suite.browser, options);
    const { page } = opened;
    await page.addInitScript(() => {
      window.told = [];
      addEventListener('DOMContentLoaded', () => {
        for (const type of ['load', 'error', 'state', 'sound', 'statistics'])
          document.querySelector('tmpi-viewer').addEventListener(type, ({ detail }) => window.told.push({ type, ...detail }));
      });
    });
    if (own) {
      await page.route('**/embed/page', (route) => route.fulfill({ contentType: 'text/html', body: pageOf(attributes) }));
      await page.goto(`${suite.server.url}/embed/page`);
    } else await page.goto(`http://127.0.0.1:${other.address().port}/?${new URLSearchParams({ attributes })}`);
    return opened;
  }
  const mode = (page, wanted) => page.waitForFunction((m) => document.querySelector('tmpi-viewer').viewer?.mode === m, wanted);

  /** Pixels of the element's scene at a pose. */
  const pixels = (page, pose) => pixelsAt(page, pose, WIDTH, HEIGHT, 'tmpi-viewer');

  /** Checks that the camera's frames are shown, one after the other. */
  async function moves(page) {
    await mode(page, 'gpu');
    const numbers = new Set();
    await until(
      async () => {
        const { number, same, other } = likenessOf(await pixels(page, {}));
        assert.ok(same > SAME_DB && same > other + 3, `frame ${number}: ${same} dB, half a film away ${other} dB`);
        return numbers.add(number).size >= 3;
      },
      () => [...numbers],
    );
  }

  test('who comes first waits, then sees and hears the room; nothing is left of it in the end', async () => {
    const { page, context, errors } = await open(`src="${suite.server.url}/" room="attic" sound`, { own: true });
    const note = page.locator('tmpi-viewer [role=status]');
    await note.getByText('Nobody is live here yet. The picture starts by itself.').waitFor();
    assert.equal(await page.evaluate(() => document.querySelector('tmpi-viewer').state), 'waiting');
    const publisher = await suite.publish('attic');
    await moves(page);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').state === 'live');
    assert.equal(await note.textContent(), '');
    assert.equal(await page.locator('tmpi-viewer .stage').getAttribute('aria-roledescription'), '3D video');
    // none before a tap, though the page asks for it
    assert.equal(await page.evaluate(() => document.querySelector('tmpi-viewer').sound), false);
    await page.locator('tmpi-viewer .stage').click();
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').sound);
    const button = page.getByRole('button', { name: 'Sound' });
    assert.equal(await button.getAttribute('aria-pressed'), 'true');
    await button.click();
    await page.waitForFunction(() => !document.querySelector('tmpi-viewer').sound);
    await page.waitForFunction(() => window.told.some((t) => t.type === 'statistics' && t.frames > 0 && t.behind >= 0));
    const told = await page.evaluate(() => window.told);
    assert.deepEqual(
      told.filter(({ type }) => type === 'sound').map(({ on }) => on),
      [true, false],
    );
    assert.equal(told.filter(({ type }) => type === 'load').length, 1, 'loaded once, however often the scene grew');
    const states = told.filter(({ type }) => type === 'state').map(({ state }) => state);
    assert.deepEqual([states[0], states.includes('waiting'), states.at(-1)], ['connecting', true, 'live']);
    const bytes = await page.evaluate(async () => (await document.querySelector('tmpi-viewer').toBlob()).size);
    assert.ok(bytes > 1000, `${bytes}`);
    await shoot(page, 'element-room');
    // the publisher goes, and comes back
    await publisher.page.getByRole('button', { name: 'Stop' }).click();
    await page.waitForFunction(() => ['ended', 'stalled'].includes(document.querySelector('tmpi-viewer').state));
    assert.notEqual(await note.textContent(), '');
    await publisher.page.getByRole('button', { name: 'Start' }).click();
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').state === 'live');
    // nobody watches any more once the element is gone
    await publisher.page.waitForFunction(() => /1 watching/.test(document.getElementById('state').textContent));
    const workers = page.workers().length;
    await page.evaluate(() => document.querySelector('tmpi-viewer').remove());
    await publisher.page.waitForFunction(() => !/1 watching/.test(document.getElementById('state').textContent));
    // the browser may tell of its end after the publisher does
    assert.equal(workers, 1);
    await until(() => !page.workers().length);
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });

  test('nothing is fetched for an element out of sight', async () => {
    const publisher = await suite.publish('attic');
    const { page, context } = await open(`src="${suite.server.url}/live/attic"`, { own: true });
    await moves(page);
    await publisher.page.waitForFunction(() => /1 watching/.test(document.getElementById('state').textContent));
    await page.evaluate(() => {
      document.querySelector('tmpi-viewer').style.marginTop = '5000px';
    });
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').viewer.asleep);
    await publisher.page.waitForFunction(() => !/1 watching/.test(document.getElementById('state').textContent));
    await page.evaluate(() => {
      document.querySelector('tmpi-viewer').style.marginTop = '';
    });
    await publisher.page.waitForFunction(() => /1 watching/.test(document.getElementById('state').textContent));
    await moves(page);
    await context.close();
    await publisher.context.close();
  });

  test('a page of another site shows it with a token for watching', async () => {
    const publisher = await suite.publish('attic');
    for (const attributes of [
      `src="${suite.server.url}/live/attic#token=${token('attic')}"`,
      `src="${suite.server.url}/v1/live/attic" token="${token('attic')}"`,
    ]) {
      const { page, context, errors } = await open(attributes);
      const asked = [];
      page.on('request', (request) => asked.push(request.url()));
      await moves(page);
      const [home, moved] = [await pixels(page, {}), await pixels(page, { tx: 0.05, yaw: -1 })];
      assert.ok(shareDifferent(home, moved, WIDTH, HEIGHT) > 0.1, 'a moved camera sees something else');
      assert.ok(!asked.some((url) => url.includes('token=')), `${asked}`);
      assert.deepEqual(errors, []);
      await context.close();
    }
    await publisher.context.close();
  });

  test('without a token, or with one for another room, it says what is missing, and another token helps', async () => {
    const publisher = await suite.publish('attic');
    for (const given of ['', ` token="${token('cellar')}"`]) {
      const { page, context } = await open(`src="${suite.server.url}/live/attic"${given}`);
      const alert = page.getByRole('alert');
      await alert.getByText(/you need a link that is still valid/).waitFor();
      await alert.getByText('The attic').waitFor();
      assert.equal(await page.evaluate(() => document.querySelector('tmpi-viewer').state), 'refused');
      await shoot(page, 'element-room-refused');
      assert.deepEqual(await page.evaluate(() => window.told.filter(({ type }) => type === 'load')), []);
      assert.equal(await page.evaluate(() => window.told.filter(({ type }) => type === 'error').length), 1);
      await page.evaluate((good) => document.querySelector('tmpi-viewer').setAttribute('token', good), token('attic'));
      await mode(page, 'gpu');
      assert.ok(await alert.isHidden());
      await context.close();
    }
    await publisher.context.close();
  });
});

// Rooms in the element, on pages of the same and of another site.
import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { randomBytes } from 'node:crypto';
import { writeFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { fractionDifferent, openPage, pixelsAt } from '../support/browser.mjs';
import { program } from '../support/program.mjs';
import { compareWithFilm, roomSuite, SAME_DB, saveScreenshot } from '../support/room.mjs';
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

  /** Another site; its pages have an element with the attributes from the query. */
  let other;
  before(async () => {
    other = createServer((request, response) => {
      const query = new URL(request.url, 'http://localhost').searchParams;
      response.writeHead(200, { 'content-type': 'text/html' });
      response.end(pageOf(query.get('attributes') ?? ''));
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

  /** Opens a page with an element, on the server's own site or another. */
  async function open(attributes, { sameSite = false, options = {} } = {}) {
    const opened = await openPage(suite.browser, { viewport: { width: 400, height: 300 }, ...options });
    const { page } = opened;
    await page.addInitScript(() => {
      window.events = [];
      addEventListener('DOMContentLoaded', () => {
        for (const type of ['load', 'error', 'state', 'sound', 'statistics'])
          document.querySelector('tmpi-viewer').addEventListener(type, ({ detail }) => window.events.push({ type, ...detail }));
      });
    });
    if (sameSite) {
      await page.route('**/embed/page', (route) => route.fulfill({ contentType: 'text/html', body: pageOf(attributes) }));
      await page.goto(`${suite.server.url}/embed/page`);
    } else await page.goto(`http://127.0.0.1:${other.address().port}/?${new URLSearchParams({ attributes })}`);
    return opened;
  }
  const waitForElementMode = (page, wanted) =>
    page.waitForFunction((m) => document.querySelector('tmpi-viewer').viewer?.mode === m, wanted);

  /** Pixels of the element's scene at a pose. */
  const pixels = (page, pose) => pixelsAt(page, pose, WIDTH, HEIGHT, 'tmpi-viewer');

  /** Checks that the element shows several of the camera's frames. */
  async function assertPlays(page) {
    await waitForElementMode(page, 'gpu');
    const numbers = new Set();
    await until(
      async () => {
        const { number, same, other } = compareWithFilm(await pixels(page, {}));
        assert.ok(same > SAME_DB && same > other + 3, `frame ${number}: ${same} dB, half a film away ${other} dB`);
        return numbers.add(number).size >= 3;
      },
      () => [...numbers],
    );
  }

  test('an early viewer waits, then sees and hears the room', async () => {
    const { page, context, errors } = await open(`src="${suite.server.url}/" room="attic" sound`, { sameSite: true });
    const note = page.locator('tmpi-viewer [role=status]');
    await note.getByText('Nobody is live here yet. The picture starts by itself.').waitFor();
    assert.equal(await page.evaluate(() => document.querySelector('tmpi-viewer').state), 'waiting');
    const publisher = await suite.publish('attic');
    await assertPlays(page);
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').state === 'live');
    assert.equal(await note.textContent(), '');
    assert.equal(await page.locator('tmpi-viewer .stage').getAttribute('aria-roledescription'), '3D video');
    // browsers allow sound only after a tap
    assert.equal(await page.evaluate(() => document.querySelector('tmpi-viewer').sound), false);
    await page.locator('tmpi-viewer .stage').click();
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').sound);
    const button = page.getByRole('button', { name: 'Sound' });
    assert.equal(await button.getAttribute('aria-pressed'), 'true');
    await button.click();
    await page.waitForFunction(() => !document.querySelector('tmpi-viewer').sound);
    await page.waitForFunction(() => window.events.some((t) => t.type === 'statistics' && t.frames > 0 && t.behind >= 0));
    const events = await page.evaluate(() => window.events);
    assert.deepEqual(
      events.filter(({ type }) => type === 'sound').map(({ on }) => on),
      [true, false],
    );
    assert.equal(events.filter(({ type }) => type === 'load').length, 1, 'one load event although the scene grows');
    const states = events.filter(({ type }) => type === 'state').map(({ state }) => state);
    assert.deepEqual([states[0], states.includes('waiting'), states.at(-1)], ['connecting', true, 'live']);
    const bytes = await page.evaluate(async () => (await document.querySelector('tmpi-viewer').toBlob()).size);
    assert.ok(bytes > 1000, `${bytes}`);
    await saveScreenshot(page, 'element-room');
    // the publisher stops and starts again
    await publisher.page.getByRole('button', { name: 'Stop' }).click();
    await page.waitForFunction(() => ['ended', 'stalled'].includes(document.querySelector('tmpi-viewer').state));
    assert.notEqual(await note.textContent(), '');
    await publisher.page.getByRole('button', { name: 'Start' }).click();
    await page.waitForFunction(() => document.querySelector('tmpi-viewer').state === 'live');
    // removing the element disconnects the viewer
    await publisher.page.waitForFunction(() => /1 watching/.test(document.getElementById('state').textContent));
    const workers = page.workers().length;
    await page.evaluate(() => document.querySelector('tmpi-viewer').remove());
    await publisher.page.waitForFunction(() => !/1 watching/.test(document.getElementById('state').textContent));
    // the browser may report the worker's end late
    assert.equal(workers, 1);
    await until(() => !page.workers().length);
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });

  describe('that is live', () => {
    let publisher;
    before(async () => {
      publisher = await suite.publish('attic');
    });
    after(() => publisher?.context.close());

    test('an element out of view disconnects', async () => {
      const { page, context } = await open(`src="${suite.server.url}/live/attic"`, { sameSite: true });
      await assertPlays(page);
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
      await assertPlays(page);
      await context.close();
    });

    test('another site shows a room with a token', async () => {
      for (const attributes of [
        `src="${suite.server.url}/live/attic#token=${token('attic')}"`,
        `src="${suite.server.url}/v1/live/attic" token="${token('attic')}"`,
      ]) {
        const { page, context, errors } = await open(attributes);
        const urls = [];
        page.on('request', (request) => urls.push(request.url()));
        await assertPlays(page);
        const [home, moved] = [await pixels(page, {}), await pixels(page, { tx: 0.05, yaw: -1 })];
        assert.ok(fractionDifferent(home, moved, WIDTH, HEIGHT) > 0.1, 'a moved camera changes the picture');
        assert.ok(!urls.some((url) => url.includes('token=')), `${urls}`);
        assert.deepEqual(errors, []);
        await context.close();
      }
    });

    test('asks for a link without a valid token', async () => {
      for (const given of ['', ` token="${token('cellar')}"`]) {
        const { page, context } = await open(`src="${suite.server.url}/live/attic"${given}`);
        const alert = page.getByRole('alert');
        await alert.getByText(/you need a link that is still valid/).waitFor();
        await alert.getByText('The attic').waitFor();
        assert.equal(await page.evaluate(() => document.querySelector('tmpi-viewer').state), 'refused');
        await saveScreenshot(page, 'element-room-refused');
        assert.deepEqual(await page.evaluate(() => window.events.filter(({ type }) => type === 'load')), []);
        assert.equal(await page.evaluate(() => window.events.filter(({ type }) => type === 'error').length), 1);
        await page.evaluate((good) => document.querySelector('tmpi-viewer').setAttribute('token', good), token('attic'));
        await waitForElementMode(page, 'gpu');
        assert.ok(await alert.isHidden());
        await context.close();
      }
    });
  });
});

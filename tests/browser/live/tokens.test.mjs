// Rooms on a server with a key: a token in the URL fragment gives access and never leaves the browser in a URL.
import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { randomBytes } from 'node:crypto';
import { writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { program } from '../support/program.mjs';
import { roomSuite, saveScreenshot } from '../support/room.mjs';

/** Requests through a proxy do not come from the local user. */
const STRANGER = { extraHTTPHeaders: { 'x-forwarded-for': '192.0.2.1' } };
const DENIED = /you need a link that is still valid/;

describe('tokens', () => {
  let key;
  const suite = roomSuite((folder) => {
    key = join(folder, 'key');
    writeFileSync(key, randomBytes(32));
    return ['--live-key', key];
  });
  const token = (...more) => execFileSync(program, ['live', 'token', 'attic', '--key', key, ...more], { encoding: 'utf8' }).trim();

  test('a page without a valid token asks for a link', async () => {
    for (const hash of ['', '#token=1.abc']) {
      const { page, context } = await suite.watch('attic', { hash, options: STRANGER });
      await page.getByText(DENIED).waitFor();
      await saveScreenshot(page, 'watch-refused');
      await page.goto(`${suite.server.url}/live/attic/publish${hash}`);
      await page.getByText(DENIED).waitFor();
      assert.ok(await page.locator('#form').isHidden());
      await context.close();
    }
  });

  test('the publisher’s link allows only watching', async () => {
    const requests = [];
    const recordRequests = async (page) => {
      page.on('request', (request) => requests.push(request.url()));
      page.on('websocket', (socket) => requests.push(socket.url()));
    };
    const publisher = await suite.publish('attic', { hash: `#token=${token('--publish')}`, prepare: recordRequests });
    // the page fetches the link from the server
    await publisher.page.waitForFunction(() => document.querySelector('#link').value);
    const link = new URL(await publisher.page.locator('#link').inputValue());
    assert.match(link.hash, /^#token=\d+-[0-9a-f]+$/);
    assert.match(await publisher.page.locator('#link-note').textContent(), /^It is valid until /);
    const { page, context, errors } = await suite.watch('attic', { hash: link.hash, prepare: recordRequests });
    await waitForMode(page, 'gpu');
    assert.ok(
      requests.some((url) => url.startsWith('ws:')) && !requests.some((url) => url.includes('token=') || url.includes('?')),
      `${requests}`,
    );
    await page.goto(`${suite.server.url}/live/attic/publish${link.hash}`);
    await page.getByText(DENIED).waitFor();
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });
});

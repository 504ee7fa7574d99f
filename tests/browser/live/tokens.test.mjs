// Rooms of a server with a key: who has a token in the address comes in, and it stays behind the #.
import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { randomBytes } from 'node:crypto';
import { writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { program } from '../support/program.mjs';
import { roomSuite, shoot } from '../support/room.mjs';

/** As if a proxy had passed the request on: nobody is this machine's own user then. */
const STRANGER = { extraHTTPHeaders: { 'x-forwarded-for': '192.0.2.1' } };
const REFUSED = /you need (?:a link|an invitation) that is still valid/;

describe('tokens', () => {
  let key;
  const suite = roomSuite((folder) => {
    key = join(folder, 'key');
    writeFileSync(key, randomBytes(32));
    return ['--live-key', key];
  });
  const token = (...more) => execFileSync(program, ['live', 'token', 'attic', '--key', key, ...more], { encoding: 'utf8' }).trim();

  test('who has none, or a wrong one, is told what is missing', async () => {
    for (const hash of ['', '#token=1.abc']) {
      const { page, context } = await suite.watch('attic', { hash, options: STRANGER });
      await page.getByText(REFUSED).waitFor();
      await shoot(page, 'watch-refused');
      await page.goto(`${suite.server.url}/live/attic/publish${hash}`);
      await page.getByText(REFUSED).waitFor();
      assert.ok(await page.locator('#form').isHidden());
      await context.close();
    }
  });

  test('a link that a publisher gives away is for watching alone', async () => {
    const requests = [];
    const note = async (page) => {
      page.on('request', (request) => requests.push(request.url()));
      page.on('websocket', (socket) => requests.push(socket.url()));
    };
    const publisher = await suite.publish('attic', { hash: `#token=${token('--publish')}`, prepare: note });
    // it is asked of the server
    await publisher.page.waitForFunction(() => document.querySelector('#link').value);
    const link = new URL(await publisher.page.locator('#link').inputValue());
    assert.match(link.hash, /^#token=\d+\.[0-9a-f]+$/);
    const { page, context, errors } = await suite.watch('attic', { hash: link.hash, prepare: note });
    await waitForMode(page, 'gpu');
    assert.ok(
      requests.some((url) => url.startsWith('ws:')) && !requests.some((url) => url.includes('token=') || url.includes('?')),
      `${requests}`,
    );
    await page.goto(`${suite.server.url}/live/attic/publish${link.hash}`);
    await page.getByText(REFUSED).waitFor();
    assert.deepEqual(errors, []);
    await context.close();
    await publisher.context.close();
  });
});

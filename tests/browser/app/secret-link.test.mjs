// Links with a secret: an owner link asks before the browser becomes another owner, a manage link does not.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage, seriousViolations } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

const SECRET = `tmpi_o_${'a'.repeat(40)}`;
const TICKET = `tmpi_t_1_${'5e'.repeat(64)}`;
const TOKEN = `tmpi_m_${'0f'.repeat(32)}`;

describe('a link with a secret', () => {
  const suite = boxSuite({ webgpu: false });

  async function open(hash, more = {}) {
    suite.server.posts.length = 0;
    const opened = await openPage(suite.browser, more);
    await opened.page.goto(`${suite.server.url}/view/box${hash}`);
    return opened;
  }
  const answer = async (page, title, button) => {
    const dialog = page.getByRole('dialog', { name: title });
    await dialog.waitFor();
    await dialog.getByRole('button', { name: button }).click();
    await dialog.waitFor({ state: 'detached' });
  };
  /** Waits until the page shows the photo. */
  const waitForViewer = (page) => page.waitForFunction(() => window.viewer);

  test('for one photo works silently and leaves the address bar', async () => {
    const { page, context } = await open(`#manage=${TOKEN}`);
    await waitForViewer(page);
    assert.deepEqual(suite.server.posts, [['/v1/photos/box/manage', `Bearer ${TOKEN}`]]);
    assert.equal(new URL(page.url()).hash, '');
    assert.equal(await page.locator('dialog[open]').count(), 0);
    await context.close();
  });

  test('of an owner does nothing until the user confirms it', async () => {
    const { page, context } = await open(`#owner=${SECRET}`);
    const dialog = page.getByRole('dialog', { name: 'Is this link your own?' });
    await dialog.waitFor();
    assert.deepEqual(suite.server.posts, [], 'no request before the answer');
    assert.equal(new URL(page.url()).hash, '', 'the secret leaves the address bar');
    assert.deepEqual(await seriousViolations(page), []);
    await page.keyboard.press('Escape');
    await waitForViewer(page);
    assert.deepEqual(suite.server.posts, []);
    await context.close();
    // the Close button also declines
    const again = await open(`#owner=${SECRET}`);
    await answer(again.page, 'Is this link your own?', 'Close');
    await waitForViewer(again.page);
    assert.deepEqual(suite.server.posts, []);
    await again.context.close();
  });

  test('of an owner replaces another owner only after confirmation', async () => {
    suite.server.state.another = true;
    for (const [button, sent] of [
      ['Close', ['/v1/owner']],
      ['Give them up', ['/v1/owner', '/v1/owner?replace=true']],
    ]) {
      const { page, context } = await open(`#owner=${SECRET}`);
      await answer(page, 'Is this link your own?', 'I made it myself');
      await answer(page, 'Give up the photos of this browser?', button);
      await waitForViewer(page);
      assert.deepEqual(
        suite.server.posts,
        sent.map((path) => [path, `Bearer ${SECRET}`]),
      );
      await context.close();
    }
    suite.server.state.another = undefined;
    const { page, context } = await open(`#owner=${TICKET}`);
    await answer(page, 'Is this link your own?', 'I made it myself');
    await waitForViewer(page);
    assert.deepEqual(suite.server.posts, [['/v1/owner', `Bearer ${TICKET}`]], 'a browser without an owner needs no second question');
    await context.close();
  });

  test('the dialogs fit small screens in both languages', async () => {
    for (const locale of ['en', 'de']) {
      const { page, context } = await open(`#owner=${SECRET}`, { locale, viewport: { width: 320, height: 480 } });
      const dialog = page.locator('.share-dialog');
      await dialog.waitFor();
      const fits = await dialog.evaluate((box) => {
        const { left, right, top, bottom } = box.getBoundingClientRect();
        return left >= 0 && right <= innerWidth && top >= 0 && bottom <= innerHeight && box.scrollWidth <= box.clientWidth;
      });
      assert.ok(fits, locale);
      await context.close();
    }
  });
});

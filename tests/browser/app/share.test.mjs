// The share dialogs: embedding, access, links and films.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { escaped, snippets } from '../../../static/app/snippets.js';
import { downloadBytes, openPage, seriousViolations, waitForMode } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

const HOSTILE = `"><script>alert(1)</script>'&<b>`;
const SIZES = [
  { width: 1280, height: 800 },
  { width: 390, height: 700 },
  { width: 844, height: 390 },
];

describe('sharing', () => {
  const suite = boxSuite();

  async function open(more = {}) {
    const opened = await suite.open({ acceptDownloads: true, ...more });
    await waitForMode(opened.page, 'gpu');
    return opened;
  }
  const dialogOf = async (page, entry, name) => {
    await page.locator('#share').click();
    await page.locator(entry).click();
    const dialog = page.getByRole('dialog', { name });
    await dialog.waitFor();
    return dialog;
  };

  test('snippets escape hostile titles', async () => {
    assert.equal(escaped(HOSTILE), '&quot;&gt;&lt;script&gt;alert(1)&lt;/script&gt;&#39;&amp;&lt;b&gt;');
    const photo = { origin: 'https://h', id: 'box', width: 4, height: 3 };
    const [plain, hostile] = ['T', HOSTILE].map((name) => snippets({ ...photo, name }));
    for (const kind of ['frame', 'element']) {
      for (const c of '<>"') assert.equal(hostile[kind].split(c).length, plain[kind].split(c).length, `${kind} ${c}`);
    }
    const { page, context } = await openPage(suite.browser);
    await page.goto(`${suite.server.url}/embed/blank`);
    const read = await page.evaluate((html) => {
      const doc = new DOMParser().parseFromString(html.frame + html.element, 'text/html');
      return [
        doc.querySelector('iframe').title,
        doc.querySelector('tmpi-viewer').getAttribute('alt'),
        doc.querySelectorAll('script').length,
      ];
    }, hostile);
    assert.deepEqual(read, [HOSTILE, HOSTILE, 1]);
    await context.close();
  });

  test('the copied snippet shows the photo on another page', async () => {
    suite.server.state.settings = { version: 1, title: 'The box' };
    const { page, context, errors } = await open();
    await context.grantPermissions(['clipboard-read', 'clipboard-write']);
    await page.locator('#share').click();
    assert.ok(await page.locator('#share-link').isVisible());
    assert.ok(await page.locator('#share-access').isHidden(), 'the access dialog is for servers with access control');
    await page.keyboard.press('Escape');
    const dialog = await dialogOf(page, '#share-embed', 'Put it on a page');
    await dialog.getByText('only on this machine').waitFor();
    await dialog.getByRole('button', { name: 'Copy: As an element' }).click();
    await dialog.getByText('Copied').waitFor();
    const html = await page.evaluate(() => navigator.clipboard.readText());
    assert.equal(html, await dialog.getByLabel('As an element', { exact: true }).inputValue());
    assert.deepEqual(await seriousViolations(page), []);
    assert.match(await dialog.getByRole('link', { name: 'Download' }).getAttribute('href'), /\/export\?format=html$/);
    await page.keyboard.press('Escape');
    await dialog.waitFor({ state: 'detached' });
    // without a clipboard API the text is selected
    await page.evaluate(() => Object.defineProperty(navigator, 'clipboard', { value: undefined }));
    await dialogOf(page, '#share-embed', 'Put it on a page');
    await dialog.getByRole('button', { name: 'Copy: In a frame' }).click();
    const selected = await page.evaluate(() => {
      const { value, selectionStart, selectionEnd } = document.activeElement;
      return [selectionStart, selectionEnd - value.length, value.startsWith('<iframe')];
    });
    assert.deepEqual(selected, [0, 0, true]);
    assert.deepEqual(errors, []);
    const other = await context.newPage();
    await other.goto(`${suite.server.url}/embed/blank`);
    await other.setContent(`<!doctype html><body>${html}</body>`);
    await other.waitForFunction(() => document.querySelector('tmpi-viewer').viewer?.mode === 'gpu');
    await context.close();
    suite.server.state.settings = undefined;
  });

  test('the access dialog limits, extends and revokes access', async () => {
    const manage = `/view/box#manage=tmpi_m_${'0f'.repeat(32)}`;
    Object.assign(suite.server.state, {
      visibility: 'private',
      links: { manage, ticket: '/v1/owner/ticket' },
      settings: { version: 1, title: 'The box' },
    });
    const before = suite.server.patches.length;
    const { page, context, errors } = await open();
    await context.grantPermissions(['clipboard-read', 'clipboard-write']);
    const dialog = await dialogOf(page, '#share-access', 'Who may see it');
    const ending = dialog.getByLabel('A link with an end date', { exact: true });
    assert.equal(await ending.inputValue(), `${suite.server.url}/view/box?expires=86400&signature=5e`);
    await dialog.getByLabel('Valid for').selectOption('A week');
    await page.waitForFunction(() => document.querySelector('.share-dialog textarea').value.includes('expires=604800&'));
    await dialog.getByRole('button', { name: 'Copy: A link with an end date' }).click();
    await dialog.getByText('Copied').waitFor();
    assert.equal(await page.evaluate(() => navigator.clipboard.readText()), await ending.inputValue());
    const other = dialog.getByLabel('A link to change it', { exact: true });
    assert.ok(await other.isHidden(), 'the secret stays hidden until requested');
    await dialog.getByText('Let somebody else change it').click();
    assert.equal(await other.inputValue(), suite.server.url + manage);
    const fresh = `/view/box#manage=tmpi_m_${'1e'.repeat(32)}`;
    suite.server.state.links = { manage: fresh };
    await dialog.getByRole('button', { name: 'Take all links back' }).click();
    await dialog.getByText('these are new').waitFor();
    assert.deepEqual(suite.server.deleted, ['/v1/photos/box/manage']);
    assert.equal(await other.inputValue(), suite.server.url + fresh);
    suite.server.state.ticket = `tmpi_t_1_${'5e'.repeat(64)}`;
    await dialog.getByText('For another browser of yours').click();
    const mine = dialog.getByLabel('The link for your other browser', { exact: true });
    assert.ok(await mine.isHidden(), 'the link is made on request');
    await dialog.getByRole('button', { name: 'Make a link' }).click();
    const note = dialog.getByText('Valid for 15 minutes');
    await note.waitFor();
    const [bottom, edge] = await note.evaluate((line) => [line, line.closest('dialog')].map((e) => e.getBoundingClientRect().bottom));
    assert.ok(bottom <= edge, 'the new text is visible');
    assert.equal(await mine.inputValue(), `${suite.server.url}/view/box#owner=${suite.server.state.ticket}`);
    suite.server.state.ticket = undefined;
    assert.deepEqual(await seriousViolations(page), []);
    await dialog.getByLabel('Who may see it', { exact: true }).selectOption('Anyone with the link');
    await dialog.getByText('Saved').waitFor();
    assert.ok(await ending.isHidden(), 'a public photo needs no expiring link');
    assert.deepEqual(JSON.parse(suite.server.patches[before].body), { visibility: 'link' });
    await page.keyboard.press('Escape');
    await dialog.waitFor({ state: 'detached' });
    // the next save uses the current version
    await page.locator('#settings').click();
    await page.locator('#set-title').fill('Another');
    await page.locator('#set-save').click();
    await page.getByText('Saved', { exact: true }).waitFor();
    assert.equal(suite.server.patches[before + 1].headers['if-match'], `"${before + 2}"`);
    // a public photo of another owner
    suite.server.state.links = undefined;
    await page.keyboard.press('Escape');
    const none = await dialogOf(page, '#share-access', 'Who may see it');
    await none.getByText('Only the person who uploaded the photo').waitFor();
    assert.equal(await none.locator('select, textarea').count(), 0);
    assert.equal(errors.length, 1, `only the rejected request: ${errors}`);
    await context.close();
    Object.assign(suite.server.state, { visibility: undefined, links: undefined, settings: undefined });
  });

  test('a link to a private photo is signed and expires', async () => {
    Object.assign(suite.server.state, { visibility: 'private', links: {} });
    const before = suite.server.patches.length;
    const { page, context, errors } = await open();
    await context.grantPermissions(['clipboard-read', 'clipboard-write']);
    await page.evaluate(() => window.viewer.moveTo({ x: 0.5, y: 0, z: 0 }));
    await page.waitForFunction(() => window.viewer.motion.now.x > 0.49);
    const dialog = await dialogOf(page, '#share-link', 'Link to this view');
    const link = dialog.getByLabel('Link to this view', { exact: true });
    assert.equal(await link.inputValue(), `${suite.server.url}/view/box?expires=86400&signature=5e#pose=0.5,0,0`);
    await dialog.getByText('Only you can see this photo.').waitFor();
    const expiry = dialog.getByText('Anyone with this link can see the photo until');
    await dialog.getByText('only on this machine').waitFor();
    const first = await expiry.textContent();
    await dialog.getByLabel('Valid for').selectOption('30 days');
    await page.waitForFunction(() => document.querySelector('.share-dialog textarea').value.includes('expires=2592000&'));
    assert.notEqual(await expiry.textContent(), first);
    assert.match(await link.inputValue(), /#pose=0\.5,0,0$/);
    await dialog.getByRole('button', { name: 'Copy: Link to this view' }).click();
    await dialog.getByText('Copied').waitFor();
    assert.equal(await page.evaluate(() => navigator.clipboard.readText()), await link.inputValue());
    assert.deepEqual(await seriousViolations(page), []);
    await dialog.getByRole('button', { name: 'Let anyone with the link see it' }).click();
    await dialog.getByText('Anyone with the link can see it.').waitFor();
    assert.equal(await link.inputValue(), `${suite.server.url}/view/box#pose=0.5,0,0`);
    assert.deepEqual(JSON.parse(suite.server.patches[before].body), { visibility: 'link' });
    await page.keyboard.press('Escape');
    // a public photo needs no dialog
    await page.locator('#share').click();
    await page.locator('#share-link').click();
    await page.getByText('Link to this view copied').waitFor();
    assert.ok((await page.evaluate(() => navigator.clipboard.readText())).startsWith(`${suite.server.url}/view/box`));
    assert.deepEqual(errors, []);
    await context.close();
    Object.assign(suite.server.state, { visibility: undefined, links: undefined, settings: undefined });
  });

  test('visitors share the signed link that they have', async () => {
    suite.server.state.visibility = 'private';
    const { page, context } = await openPage(suite.browser);
    const signed = `${suite.server.url}/view/box?expires=4102444800&signature=5e`;
    const byKey = `${suite.server.url}/view/box?key=0123abcd&expires=4102444800&signature=5e`;
    for (const [address, link] of [
      [signed, signed],
      [byKey, byKey],
      [`${suite.server.url}/view/box`, null],
    ]) {
      await page.goto(address);
      await page.waitForFunction(() => window.viewer);
      const dialog = await dialogOf(page, '#share-link', 'Link to this view');
      if (link) {
        assert.equal(await dialog.getByRole('textbox').inputValue(), link);
        await dialog.getByText('2100').waitFor();
      } else {
        await dialog.getByText('Only the person who uploaded the photo can make a link').waitFor();
        assert.equal(await dialog.getByRole('textbox').count(), 0);
      }
    }
    await context.close();
    suite.server.state.visibility = undefined;
  });

  test('snippets appear once others may see the photo', async () => {
    suite.server.state.visibility = 'private';
    const { page, context } = await open();
    const dialog = await dialogOf(page, '#share-embed', 'Put it on a page');
    const frame = dialog.getByLabel('In a frame', { exact: true });
    assert.ok(await frame.isHidden());
    await dialog.getByRole('button', { name: 'Let anyone with the link see it' }).click();
    await frame.waitFor();
    await context.close();
    Object.assign(suite.server.state, { visibility: undefined, settings: undefined });
  });

  test('makes, shows and saves a GIF; cancelling leaves nothing', async () => {
    const { page, context, errors } = await open();
    const dialog = await dialogOf(page, '#share-film', 'A film or GIF');
    await dialog.getByLabel('Kind').selectOption('gif');
    await dialog.getByLabel('Movement').selectOption('wiggle');
    await dialog.getByRole('button', { name: 'Make it' }).click();
    await dialog.getByRole('img', { name: 'The film' }).waitFor();
    assert.ok(await page.waitForFunction(() => document.querySelector('.share-dialog img').naturalWidth === 200));
    const [download] = await Promise.all([page.waitForEvent('download'), dialog.getByRole('link', { name: 'Save' }).click()]);
    assert.match(download.suggestedFilename(), /-wiggle\.gif$/);
    assert.equal((await downloadBytes(download)).toString('latin1', 0, 6), 'GIF89a');
    assert.deepEqual(await seriousViolations(page), []);

    await dialog.getByLabel('Movement').selectOption('orbit');
    await dialog.getByLabel('Length').selectOption('8');
    await dialog.getByRole('button', { name: 'Make it' }).click();
    await dialog.getByRole('button', { name: 'Cancel' }).click();
    await dialog.getByText('Cancelled.').waitFor();
    assert.equal(await dialog.locator('img, video').count(), 0);
    await dialog.getByRole('button', { name: 'Close' }).click();
    await dialog.waitFor({ state: 'detached' });
    assert.equal(await page.evaluate(() => window.viewer.asleep), false);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('dialogs fit every screen in both languages', async () => {
    Object.assign(suite.server.state, { visibility: 'private', links: { manage: `/view/box#manage=tmpi_m_${'a'.repeat(64)}` } });
    for (const locale of ['en', 'de']) {
      const { page, context } = await open({ locale });
      for (const viewport of SIZES) {
        await page.setViewportSize(viewport);
        for (const entry of ['#share-link', '#share-embed', '#share-film', '#share-access']) {
          await page.locator('#share').click();
          await page.locator(entry).click();
          const dialog = page.locator('.share-dialog');
          await dialog.waitFor();
          const fits = await dialog.evaluate((element) => {
            const { left, right, top, bottom } = element.getBoundingClientRect();
            return left >= 0 && right <= innerWidth && top >= 0 && bottom <= innerHeight && element.scrollWidth <= element.clientWidth;
          });
          assert.ok(fits, `${entry} in ${locale} at ${viewport.width}×${viewport.height}`);
          await dialog.locator('.row button').last().click();
          await dialog.waitFor({ state: 'detached' });
        }
      }
      await context.close();
    }
    Object.assign(suite.server.state, { visibility: undefined, links: undefined });
  });
});

// The second language.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { files, source } from '../support/modules.mjs';
import { photo, uploadSuite } from '../support/upload-page.mjs';

// the module looks at the browser's language when it is loaded
Object.defineProperty(globalThis, 'navigator', { value: { language: 'de-DE' }, configurable: true });
const { t } = await import('../../../static/i18n/messages.js');

/** The same in both languages, or a name. */
const SAME = new Set(['tmpi', 'Live', 'Download', 'Reset']);

/** Texts of scripts: what is handed to `t` as it stands. */
function spoken() {
  const calls = files().filter((name) => /^(?:app|i18n|live|film)\/.*\.js$/.test(name) && name !== 'i18n/messages.js');
  return calls.flatMap((name) =>
    [...source(name).matchAll(/\bt\(\s*'((?:[^'\\]|\\.)*)'/g)].map(([, text]) => [name, text.replaceAll("\\'", "'")]),
  );
}

/** Texts of pages: what stands between tags, and what is said of controls. */
function written() {
  const pages = files().filter((name) => name.endsWith('-page.html') && !name.includes('embed'));
  return pages.flatMap((name) => {
    const body = source(name)
      .replace(/^[\s\S]*<body/, '<body')
      .replace(/<(pre|code)\b[\s\S]*?<\/\1>/g, '');
    const between = [...body.matchAll(/>([^<>]*[A-Za-z][^<>]*)</g)];
    const labels = [...body.matchAll(/ (?:title|aria-label|aria-roledescription)="([^"]+)"/g)];
    return [...between, ...labels].map(([, text]) => [name, text.trim().replace(/\s+/g, ' ')]);
  });
}

describe('messages', () => {
  const suite = uploadSuite();

  test('has a word for each that scripts and pages say', () => {
    const all = [...spoken(), ...written()];
    assert.ok(all.length > 200, `${all.length} texts`);
    assert.deepEqual(
      all.filter(([, text]) => t(text) === text && !SAME.has(text)),
      [],
    );
  });

  test('the page speaks German where the browser does', async () => {
    const { page, context } = await suite.open({ pages: [{ photos: [photo('a')] }], options: { locale: 'de-DE' } });
    await page.getByText('Fotos auswählen', { exact: true }).first().waitFor();
    await page.getByRole('button', { name: /löschen$/ }).waitFor();
    assert.equal(await page.locator('html').getAttribute('lang'), 'de');
    const english = await page.evaluate(() => document.body.innerText.match(/\b(Drop|Choose|Options|Photos|Undo|removed)\b/g));
    assert.equal(english, null);
    await context.close();
  });
});

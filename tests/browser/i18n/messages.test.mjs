// The German translation.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { openPage } from '../support/browser.mjs';
import { files, source } from '../support/import-graph.mjs';
import { photo, uploadSuite } from '../support/upload-page.mjs';

// the modules read the browser's language when they load
Object.defineProperty(globalThis, 'navigator', { value: { language: 'de-DE' }, configurable: true });
const { t } = await import('../../../static/i18n/messages.js');
const { ELEMENT, word } = await import('../../../static/i18n/element.js');

/** Texts that are the same in both languages. */
const SAME = new Set(['tmpi', 'Live', 'Download', 'Reset']);
const TABLES = ['i18n/element.js', 'i18n/messages.js'];
/** A single-quoted string. */
const QUOTED = /'((?:[^'\\\n]|\\.)*)'/g;

const scripts = (folders) => files().filter((name) => folders.test(name) && name.endsWith('.js') && !TABLES.includes(name));
const pages = () => files().filter((name) => name.endsWith('-page.html') && !name.includes('embed'));
const unescaped = (text) => text.replaceAll("\\'", "'");

/** String literals that scripts pass to a function. */
const textsPassedTo = (name, folders) =>
  scripts(folders).flatMap((file) =>
    [...source(file).matchAll(new RegExp(`\\b${name}\\(\\s*${QUOTED.source}`, 'g'))].map(([, text]) => [file, unescaped(text)]),
  );

/** Texts of pages: text between tags, and labels. */
function pageTexts() {
  return pages().flatMap((name) => {
    const body = source(name)
      .replace(/^[\s\S]*<body/, '<body')
      .replace(/<(pre|code)\b[\s\S]*?<\/\1>/g, '');
    const between = [...body.matchAll(/>([^<>]*[A-Za-z][^<>]*)</g)];
    const labels = [...body.matchAll(/ (?:title|aria-label|aria-roledescription)="([^"]+)"/g)];
    return [...between, ...labels].map(([, text]) => [name, text.trim().replace(/\s+/g, ' ')]);
  });
}

/** Keys of a translation table. */
const keys = (name) =>
  [...source(name).matchAll(/^(?: {2}|.*\{ )?(?:'((?:[^'\\\n]|\\.)*)'|(\w+)):\s/gm)].map(([, quoted, plain]) => unescaped(quoted ?? plain));

describe('messages', () => {
  const suite = uploadSuite();

  test('translate every text of scripts and pages', () => {
    const all = [...textsPassedTo('t', /^(?:app|element|film|i18n|live|view)\//), ...pageTexts()];
    assert.ok(all.length > 200, `${all.length} texts`);
    assert.deepEqual(
      all.filter(([, text]) => t(text) === text && !SAME.has(text)),
      [],
    );
  });

  test('translate every text of the element', () => {
    const all = textsPassedTo('word', /^element\//).map(([, text]) => text);
    assert.deepEqual([...new Set(all)].toSorted(), Object.keys(ELEMENT).toSorted());
    for (const text of all) assert.ok(word(text) !== text && t(text) === word(text), text);
  });

  test('the element has no untranslated text', () => {
    // URLs, attribute names and shapes do not look like sentences
    const words = /^(?:[A-Z][a-z]+(?: |$)|\d\w* [a-z]|.*[a-z] [a-z]+ [a-z])/;
    const bare = scripts(/^element\//).flatMap((name) => {
      const code = source(name)
        .replace(/^\s*(?:\/\/|\/?\*).*$/gm, '')
        .replace(/`[^`]*`/g, '')
        .replace(/\b(?:t|word|Error)\(\s*'(?:[^'\\\n]|\\.)*'/g, '');
      return [...code.matchAll(QUOTED)].filter(([, text]) => words.test(text)).map(([, text]) => [name, text]);
    });
    assert.deepEqual(bare, []);
  });

  test('have no unused translation', () => {
    const texts = [...scripts(/./), ...pages()].map((name) => unescaped(source(name)).replace(/\s+/g, ' ')).join('\n');
    const all = TABLES.flatMap(keys);
    assert.ok(all.length > 250, `${all.length} keys`);
    assert.deepEqual(
      all.filter((key) => !texts.includes(key)),
      [],
    );
  });

  test('the page is German in a German browser', async () => {
    const { page, context } = await suite.open({ pages: [{ photos: [photo('a')] }], options: { locale: 'de-DE' } });
    await page.getByText('Fotos auswählen', { exact: true }).first().waitFor();
    await page.getByRole('button', { name: /löschen$/ }).waitFor();
    assert.equal(await page.locator('html').getAttribute('lang'), 'de');
    const english = await page.evaluate(() => document.body.innerText.match(/\b(Drop|Choose|Options|Photos|Undo|removed)\b/g));
    assert.equal(english, null);
    await context.close();
  });

  test('the element is German on a page of another site', async () => {
    const { page, context } = await openPage(suite.browser, { locale: 'de-DE' });
    await page.goto(`${suite.server.url}/embed?host=${suite.server.url}`);
    const viewer = page.locator('tmpi-viewer');
    await viewer.getByRole('button', { name: 'Vollbild' }).waitFor();
    const stage = viewer.locator('.stage');
    assert.equal(await stage.getAttribute('aria-roledescription'), '3D-Foto');
    await viewer.evaluate((element) => element.setAttribute('room', 'attic'));
    assert.equal(await stage.getAttribute('aria-roledescription'), '3D-Video');
    await context.close();
  });
});

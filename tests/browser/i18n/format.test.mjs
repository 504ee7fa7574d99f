// Formatting of numbers and sentences.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';

// the module reads the browser's language when it loads
Object.defineProperty(globalThis, 'navigator', { value: { language: 'en' }, configurable: true });
const { formatBytes, queueText, sentence, stageText } = await import('../../../static/i18n/format.js');
const { t } = await import('../../../static/i18n/messages.js');

describe('format', () => {
  test('formatBytes shows at most three digits', () => {
    const cases = {
      0: '0 B',
      999: '999 B',
      1000: '1.0 kB',
      9949: '9.9 kB',
      9951: '10 kB',
      999499: '999 kB',
      999500: '1.0 MB',
      5e9: '5.0 GB',
      5e12: '5000 GB',
    };
    for (const [bytes, want] of Object.entries(cases)) assert.equal(formatBytes(Number(bytes)), want);
  });

  test('an unknown stage keeps the server’s name', () => {
    assert.equal(stageText('encode'), 'Packing');
    assert.equal(stageText('polish'), 'polish');
  });

  test('queue positions, placeholders and sentences', () => {
    assert.equal(queueText(0), 'Waiting for its turn');
    assert.equal(queueText(3), 'Waiting for its turn, 3 ahead');
    assert.equal(t('{1} before {0}', 'a', 'b'), 'b before a');
    assert.equal(sentence('no.'), 'No.');
  });
});

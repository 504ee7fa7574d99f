// A hidden page receives sound, but no pictures and tiles.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { roomSuite, SAME_DB, shownFrame } from '../support/room.mjs';

/** Fakes a hidden or visible page. */
const setHidden = (page, hidden) =>
  page.evaluate((value) => {
    Object.defineProperty(document, 'hidden', { value, configurable: true });
    document.dispatchEvent(new Event('visibilitychange'));
  }, hidden);

describe('a hidden page', () => {
  const suite = roomSuite();

  test('receives only sound until it is visible again', async (t) => {
    const publisher = await suite.publish('attic');
    const { page, context, errors } = await suite.watch('attic');
    await waitForMode(page, 'gpu');
    await page.getByRole('button', { name: 'Sound' }).click();
    await page.waitForFunction(() => window.sound.played > 0.5 && window.measured.frame > 5 && window.measured.kbits > 150);
    const { kbits } = await page.evaluate(() => window.measured);
    await setHidden(page, true);
    // wait for pictures in flight
    await page.waitForFunction((before) => window.measured.kbits < before / 2 && window.measured.frames === 0, kbits);
    const { played, frame } = await page.evaluate(() => ({ played: window.sound.played, frame: window.measured.frame }));
    await page.waitForFunction((before) => window.sound.played > before + 2, played);
    const hidden = await page.evaluate(() => ({ ...window.measured, state: document.body.dataset.state }));
    assert.equal(hidden.frame, frame);
    assert.ok(hidden.kbits > 0 && hidden.kbits < kbits / 2, `${hidden.kbits} kbit/s hidden, ${kbits} before`);
    assert.equal(hidden.state, 'live');
    t.diagnostic(`${kbits.toFixed(0)} kbit/s visible, ${hidden.kbits.toFixed(0)} hidden`);
    await setHidden(page, false);
    await page.waitForFunction((before) => window.measured.frame > before + 5, frame);
    const { number, same } = await shownFrame(page);
    assert.ok(same > SAME_DB, `frame ${number}: ${same} dB`);
    assert.deepEqual([...errors, ...publisher.errors], []);
    await context.close();
    await publisher.context.close();
  });
});

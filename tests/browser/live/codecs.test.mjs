// The codecs that the publisher's page tries, which the server must accept.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { waitForMode } from '../support/browser.mjs';
import { roomSuite, SAME_DB, shownFrame } from '../support/room.mjs';

describe('a browser without an encoder for H.264', () => {
  const suite = roomSuite();

  test('sends VP9, which the server and viewers decode', async (t) => {
    const prepare = (page) =>
      page.addInitScript(() => {
        const original = VideoEncoder.isConfigSupported.bind(VideoEncoder);
        VideoEncoder.isConfigSupported = async (config) =>
          config.codec.startsWith('avc1') ? { supported: false, config } : original(config);
      });
    const publisher = await suite.publish('attic', { prepare });
    assert.equal(await publisher.page.evaluate(() => window.publisher.codec), 'vp09.00.10.08');
    const { page, context, errors } = await suite.watch('attic');
    await waitForMode(page, 'gpu');
    await page.waitForFunction(() => window.measured);
    const { frame } = await page.evaluate(() => window.measured);
    await page.waitForFunction((before) => window.measured.frame > before + 20, frame);
    const { number, same, other } = await shownFrame(page);
    t.diagnostic(`frame ${number}: ${same.toFixed(1)} dB, half a film away ${other.toFixed(1)} dB`);
    assert.ok(same > SAME_DB && same > other + 3, `${same} dB, half a film away ${other} dB`);
    assert.equal(await publisher.page.evaluate(() => window.publisher.codec), 'vp09.00.10.08', 'the server accepted the codec');
    assert.deepEqual([...errors, ...publisher.errors], []);
    await context.close();
    await publisher.context.close();
  });
});

// JPEG frames from cameras that omit the end marker.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { boxSuite } from '../support/suite.mjs';

describe('a JPEG frame', () => {
  const suite = boxSuite({ webgpu: false });

  test('decodes without all or half of its end marker', async () => {
    const { page, context, errors } = await suite.open();
    const sizes = await page.evaluate(async () => {
      const { JPEG, FrameDecoder } = await import('/static/live/frame-decoder.js');
      const canvas = new OffscreenCanvas(64, 40);
      canvas.getContext('2d').fillRect(8, 8, 30, 20);
      const whole = new Uint8Array(await (await canvas.convertToBlob({ type: 'image/jpeg' })).arrayBuffer());
      const decoded = (data) =>
        new Promise((done, failed) => {
          FrameDecoder.of(JPEG, done, failed).then((pictures) => pictures.decode({ frame: 1, time: 0, key: true, data }, 0));
        });
      const cuts = [0, 1, 2].map((bytes) => whole.slice(0, whole.length - bytes));
      return Promise.all(cuts.map(async (data) => [(await decoded(data)).picture.width, (await decoded(data)).picture.height]));
    });
    assert.deepEqual(sizes, [
      [64, 40],
      [64, 40],
      [64, 40],
    ]);
    assert.deepEqual(errors, []);
    await context.close();
  });
});

// Errors of camera frames.
import assert from 'node:assert/strict';
import { afterEach, describe, test } from 'node:test';
import { eachFrame } from '../../../static/live/camera-frames.js';
import { until } from '../support/until.mjs';

describe('camera frames', () => {
  afterEach(() => {
    delete globalThis.MediaStreamTrackProcessor;
  });

  test('a failed frame is reported and closed; others continue', async () => {
    const closed = [];
    const frames = [0, 1, 2].map((number) => ({ number, close: () => closed.push(number) }));
    globalThis.MediaStreamTrackProcessor = class {
      readable = new ReadableStream({
        start(controller) {
          for (const frame of frames) controller.enqueue(frame);
          controller.close();
        },
      });
    };
    const [taken, failed] = [[], []];
    const take = (frame) => {
      if (frame.number === 1) throw new Error('an encoder that is closed');
      taken.push(frame.number);
    };
    const stop = eachFrame(null, null, take, (error) => failed.push(error.message));
    await until(
      () => taken.length === 2,
      () => ({ taken, failed, closed }),
    );
    assert.deepEqual([taken, failed, closed], [[0, 2], ['an encoder that is closed'], [1]]);
    stop();
  });

  test('an unreadable camera is reported', async () => {
    globalThis.MediaStreamTrackProcessor = class {
      readable = new ReadableStream({ start: (controller) => controller.error(new Error('the camera is gone')) });
    };
    const reason = await new Promise((resume) => eachFrame(null, null, () => {}, resume));
    assert.equal(reason.message, 'the camera is gone');
  });
});

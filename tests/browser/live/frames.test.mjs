// Frames of a camera, and views of the server, that fail.
import assert from 'node:assert/strict';
import { afterEach, describe, test } from 'node:test';
import { eachFrame } from '../../../static/live/frames.js';
import { ServedViews } from '../../../static/live/served-views.js';
import { until } from '../support/until.mjs';

describe('frames of a camera', () => {
  afterEach(() => {
    delete globalThis.MediaStreamTrackProcessor;
  });

  test('one that cannot be taken is told of and closed, and the others come', async () => {
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
    await until(() => taken.length === 2);
    assert.deepEqual([taken, failed, closed], [[0, 2], ['an encoder that is closed'], [1]]);
    stop();
  });

  test('a camera that cannot be read is told of', async () => {
    globalThis.MediaStreamTrackProcessor = class {
      readable = new ReadableStream({ start: (controller) => controller.error(new Error('the camera is gone')) });
    };
    const reason = await new Promise((resume) => eachFrame(null, null, () => {}, resume));
    assert.equal(reason.message, 'the camera is gone');
  });
});

describe('views of the server', () => {
  test('one that is never answered is given up', async () => {
    const { fetch, AbortSignal: Signal } = globalThis;
    const soon = Signal.timeout;
    try {
      Signal.timeout = () => soon.call(Signal, 20);
      globalThis.fetch = (_, { signal } = {}) =>
        new Promise((_, refuse) => signal?.addEventListener('abort', () => refuse(signal.reason), { once: true }));
      const pose = { tx: 0, ty: 0, tz: 0, yaw: 0, pitch: 0, roll: 0 };
      const refused = [];
      const room = { address: 'http://tmpi.example/v1/live/attic', token: '' };
      const on = { shown: () => {}, refused: (state) => refused.push(state) };
      const views = new ServedViews({}, room, { width: 320, height: 240 }, on);
      views.show(pose, 60, { width: 320, height: 240 }, { x: 0, y: 0, width: 1, height: 1 });
      await until(() => refused.length);
      assert.equal(refused[0], 'away');
      views.dispose();
    } finally {
      Object.assign(globalThis, { fetch });
      Signal.timeout = soon;
    }
  });
});

// Frames of a camera that fail, and rooms that have no place.
import assert from 'node:assert/strict';
import { afterEach, describe, test } from 'node:test';
import { Connection } from '../../../static/live/connection.js';
import { eachFrame } from '../../../static/live/frames.js';

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

describe('a room without a place', () => {
  test('is asked for less and less often', async (t) => {
    let asked = 0;
    const full = { publishing: true, viewers: 1024, full: true, may_publish: false };
    t.mock.method(globalThis, 'fetch', async () => {
      asked++;
      return Response.json(full);
    });
    t.mock.timers.enable({ apis: ['setTimeout'] });
    const states = [];
    const connection = new Connection(
      { address: 'http://tmpi.example/v1/live/hall', token: '' },
      { message() {}, state: (s) => states.push(s) },
    );
    const settled = () => new Promise((resume) => setImmediate(resume));
    await connection.start();
    const pauses = [];
    for (let pause = 0; pauses.length < 5; pause++) {
      const before = asked;
      t.mock.timers.tick(1000);
      await settled();
      if (asked === before) continue;
      pauses.push(pause + 1);
      pause = -1;
    }
    connection.stop();
    assert.deepEqual(pauses, [5, 10, 20, 30, 30], 'seconds');
    assert.ok(states.length === 6 && states.every((s) => s === 'full'), `${states}`);
  });
});

// Connecting to a room.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { Connection } from '../../../static/live/connection.js';

describe('a full room', () => {
  test('is polled less and less often', async (t) => {
    let requests = 0;
    const full = { publishing: true, viewers: 1024, full: true, may_publish: false };
    t.mock.method(globalThis, 'fetch', async () => {
      requests++;
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
      const before = requests;
      t.mock.timers.tick(1000);
      await settled();
      if (requests === before) continue;
      pauses.push(pause + 1);
      pause = -1;
    }
    connection.stop();
    assert.deepEqual(pauses, [5, 10, 20, 30, 30], 'seconds');
    assert.ok(states.length === 6 && states.every((s) => s === 'full'), `${states}`);
  });
});

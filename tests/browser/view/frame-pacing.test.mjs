// Resolution while something moves.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { FramePacing, SLOW_MS } from '../../../static/view/frame-pacing.js';

/** A renderer whose frames take `ms` on a fake clock. */
function renderer(t, ms) {
  let now = 0;
  t.mock.method(performance, 'now', () => now);
  return {
    idle: async () => {
      now += ms;
    },
  };
}

describe('frame pacing', () => {
  test('slow frames reduce the resolution while something moves', async (t) => {
    const pacing = new FramePacing();
    const slow = renderer(t, SLOW_MS + 1);
    await pacing.measure(slow, () => false);
    assert.equal(pacing.detail, 1, 'full resolution at rest');
    await pacing.measure(slow, () => true);
    const once = pacing.detail;
    assert.ok(once < 1);
    for (let i = 0; i < 20; i++) await pacing.measure(slow, () => true);
    assert.equal(pacing.detail, 0.5);
    const room = new FramePacing(true);
    for (let i = 0; i < 20; i++) await room.measure(slow, () => true);
    assert.equal(room.detail, 0.2, 'a fifth for rooms');
  });

  test('fast frames restore the resolution', async (t) => {
    const pacing = new FramePacing();
    pacing.detail = 0.5;
    await pacing.measure(renderer(t, SLOW_MS * 0.75), () => true);
    assert.equal(pacing.detail, 0.5);
    for (let i = 0; i < 20; i++) await pacing.measure(renderer(t, SLOW_MS / 4), () => true);
    assert.equal(pacing.detail, 1);
  });

  test('smooths the frame time and skips overlapping measurements', async (t) => {
    const pacing = new FramePacing();
    assert.equal(await pacing.measure(renderer(t, 10), () => false), 10);
    assert.equal(await pacing.measure(renderer(t, 30), () => false), 30);
    assert.ok(pacing.ms > 10 && pacing.ms < 20, `${pacing.ms}`);
    let finish;
    const first = pacing.measure({ idle: () => new Promise((resume) => (finish = resume)) }, () => false);
    assert.equal(await pacing.measure(renderer(t, 5), () => false), null);
    finish();
    assert.notEqual(await first, null);
    assert.equal(await pacing.measure({ idle: () => Promise.reject(new Error('lost')) }, () => false), null);
    assert.equal(await pacing.measure(renderer(t, 5), () => false), 5, 'measuring continues after a lost device');
  });
});

// Resolution while something moves.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { AdaptiveResolution, SLOW_MS } from '../../../static/view/adaptive-resolution.js';

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

describe('adaptive resolution', () => {
  test('slow frames reduce the resolution while something moves', async (t) => {
    const resolution = new AdaptiveResolution();
    const slow = renderer(t, SLOW_MS + 1);
    await resolution.measure(slow, () => false);
    assert.equal(resolution.detail, 1, 'full resolution at rest');
    await resolution.measure(slow, () => true);
    const once = resolution.detail;
    assert.ok(once < 1);
    for (let i = 0; i < 20; i++) await resolution.measure(slow, () => true);
    assert.equal(resolution.detail, 0.5);
    const room = new AdaptiveResolution(true);
    for (let i = 0; i < 20; i++) await room.measure(slow, () => true);
    assert.equal(room.detail, 0.2, 'a fifth for rooms');
  });

  test('fast frames restore the resolution', async (t) => {
    const resolution = new AdaptiveResolution();
    resolution.detail = 0.5;
    await resolution.measure(renderer(t, SLOW_MS * 0.75), () => true);
    assert.equal(resolution.detail, 0.5);
    for (let i = 0; i < 20; i++) await resolution.measure(renderer(t, SLOW_MS / 4), () => true);
    assert.equal(resolution.detail, 1);
  });

  test('smooths the frame time and skips overlapping measurements', async (t) => {
    const resolution = new AdaptiveResolution();
    assert.equal(await resolution.measure(renderer(t, 10), () => false), 10);
    assert.equal(await resolution.measure(renderer(t, 30), () => false), 30);
    assert.ok(resolution.ms > 10 && resolution.ms < 20, `${resolution.ms}`);
    let finish;
    const first = resolution.measure({ idle: () => new Promise((resume) => (finish = resume)) }, () => false);
    assert.equal(await resolution.measure(renderer(t, 5), () => false), null);
    finish();
    assert.notEqual(await first, null);
    assert.equal(await resolution.measure({ idle: () => Promise.reject(new Error('lost')) }, () => false), null);
    assert.equal(await resolution.measure(renderer(t, 5), () => false), 5, 'measuring continues after a lost device');
  });
});

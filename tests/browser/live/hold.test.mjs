// How long frames wait for their tiles.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { Hold } from '../../../static/live/hold.js';

/** A room of 30 frames a second, whose tiles come `late` ms after their frame. */
function room(late, frames = 60) {
  const hold = new Hold();
  for (let frame = 0; frame < frames; frame++) {
    hold.arrived(frame, frame * 33);
    hold.tiles(frame, frame * 33 + late);
  }
  const at = frames * 33;
  hold.arrived(frames, at);
  return { hold, next: { frame: frames, arrived: at }, at };
}

describe('a frame', () => {
  test('is not held before any tiles came', () => {
    const hold = new Hold();
    hold.arrived(0, 100);
    assert.equal(hold.left({ frame: 0, arrived: 100 }, 100), 0);
  });

  test('is held about as long as its tiles usually take, and no longer once they are there', () => {
    const { hold, next, at } = room(12);
    const left = hold.left(next, at);
    assert.ok(left > 12 && left < 24, `${left}`);
    assert.ok(Math.abs(hold.left(next, at + 5) - (left - 5)) < 1e-9);
    hold.tiles(next.frame, at + 11);
    assert.equal(hold.left(next, at + 11), 0);
  });

  test('is never held for longer than one and a half frames', () => {
    const { hold, next, at } = room(400);
    const left = hold.left(next, at);
    assert.ok(left > 33 && left < 51, `${left}`);
    assert.ok(hold.left(next, at + 60) <= 0);
  });
});

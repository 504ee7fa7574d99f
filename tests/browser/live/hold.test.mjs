// How long frames wait for their tiles.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { Hold } from '../../../static/live/hold.js';

/** A room of 30 frames a second, whose tiles come `late` ms after their frame, with every frame or more seldom. */
function room(late, frames = 60, every = 1) {
  const hold = new Hold();
  for (let frame = 0; frame < frames; frame++) {
    hold.arrived(frame, frame * 33);
    if (frame % every === 0) hold.tiles(frame, frame * 33 + late);
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
    const { hold, next, at } = room(9);
    const left = hold.left(next, at);
    assert.ok(left > 9 && left < 16, `${left}`);
    assert.ok(Math.abs(hold.left(next, at + 5) - (left - 5)) < 1e-9);
    hold.tiles(next.frame, at + 8);
    assert.equal(hold.left(next, at + 8), 0);
  });

  test('is not held where they usually take longer than half of the time to the next one', () => {
    for (const late of [12, 40, 400]) {
      const { hold, next, at } = room(late);
      assert.equal(hold.left(next, at), 0, `${late}`);
    }
  });

  test('is not held where the room rests: so soon after tiles no others have come', () => {
    for (const every of [2, 3]) {
      // the frame before the last one had tiles, or the last one
      for (let frames = 60; frames < 60 + every; frames++) {
        const { hold, next, at } = room(9, frames, every);
        const left = hold.left(next, at);
        if (frames % every === 0) assert.ok(left > 9, `${every}, ${frames}: ${left}`);
        else assert.equal(left, 0, `${every}, ${frames}`);
      }
    }
    const { hold, next, at } = room(9, 7, 2);
    assert.ok(hold.left(next, at) > 9, 'of few tiles nothing is known yet');
  });

  test('is not held where nothing moves, and is again once tiles have come', () => {
    const { hold, at } = room(9);
    const later = (frames) => ({ frame: 60 + frames, arrived: at + frames * 33 });
    for (let frame = 1; frame < 40; frame++) hold.arrived(60 + frame, at + frame * 33);
    assert.ok(hold.left(later(3), at + 3 * 33) > 9);
    assert.equal(hold.left(later(39), at + 39 * 33), 0);
    hold.tiles(99, at + 39 * 33 + 9);
    hold.arrived(100, at + 40 * 33);
    assert.ok(hold.left(later(40), at + 40 * 33) > 9);
  });
});

describe('tiles that came after their frame was shown', () => {
  test('wait for the next one, which is to come soon', () => {
    const { hold, at } = room(40);
    const wait = hold.next(at + 20);
    assert.ok(wait > 13 && wait < 33, `${wait}`);
    assert.ok(hold.next(at + 60) <= 0, 'it did not come');
  });

  test('are shown at once where frames come seldom', () => {
    const hold = new Hold();
    for (let frame = 0; frame < 60; frame++) hold.arrived(frame, frame * 200);
    assert.equal(hold.next(59 * 200 + 20), 0);
  });
});

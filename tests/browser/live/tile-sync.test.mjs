// How long frames wait for their tiles.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { TileSync } from '../../../static/live/tile-sync.js';

/** A room with 30 frames per second; tiles arrive `late` ms after every `every`th frame. */
function room(late, frames = 60, every = 1) {
  const sync = new TileSync();
  for (let frame = 0; frame < frames; frame++) {
    sync.frameArrived(frame, frame * 33);
    if (frame % every === 0) sync.tilesArrived(frame, frame * 33 + late);
  }
  const at = frames * 33;
  sync.frameArrived(frames, at);
  return { sync, next: { frame: frames, arrived: at }, at };
}

describe('a frame', () => {
  test('does not wait before the first tiles', () => {
    const sync = new TileSync();
    sync.frameArrived(0, 100);
    assert.equal(sync.waitFor({ frame: 0, arrived: 100 }, 100), 0);
  });

  test('waits about as long as tiles usually take', () => {
    const { sync, next, at } = room(9);
    const left = sync.waitFor(next, at);
    assert.ok(left > 9 && left < 16, `${left}`);
    assert.ok(Math.abs(sync.waitFor(next, at + 5) - (left - 5)) < 1e-9);
    sync.tilesArrived(next.frame, at + 8);
    assert.equal(sync.waitFor(next, at + 8), 0);
  });

  test('does not wait if tiles are usually slow', () => {
    for (const late of [12, 40, 400]) {
      const { sync, next, at } = room(late);
      assert.equal(sync.waitFor(next, at), 0, `${late}`);
    }
  });

  test('does not wait between rare tiles', () => {
    for (const every of [2, 3]) {
      // the last frame, or an earlier one, had tiles
      for (let frames = 60; frames < 60 + every; frames++) {
        const { sync, next, at } = room(9, frames, every);
        const left = sync.waitFor(next, at);
        if (frames % every === 0) assert.ok(left > 9, `${every}, ${frames}: ${left}`);
        else assert.equal(left, 0, `${every}, ${frames}`);
      }
    }
    const { sync, next, at } = room(9, 7, 2);
    assert.ok(sync.waitFor(next, at) > 9, 'few tiles say nothing about the rate');
  });

  test('does not wait while nothing moves', () => {
    const { sync, at } = room(9);
    const later = (frames) => ({ frame: 60 + frames, arrived: at + frames * 33 });
    for (let frame = 1; frame < 40; frame++) sync.frameArrived(60 + frame, at + frame * 33);
    assert.ok(sync.waitFor(later(3), at + 3 * 33) > 9);
    assert.equal(sync.waitFor(later(39), at + 39 * 33), 0);
    sync.tilesArrived(99, at + 39 * 33 + 9);
    sync.frameArrived(100, at + 40 * 33);
    assert.ok(sync.waitFor(later(40), at + 40 * 33) > 9);
  });
});

describe('late tiles', () => {
  test('wait for the next frame if it is due soon', () => {
    const { sync, at } = room(40);
    const wait = sync.lateTilesWait(at + 20);
    assert.ok(wait > 13 && wait < 33, `${wait}`);
    assert.ok(sync.lateTilesWait(at + 60) <= 0, 'the next frame is overdue');
  });

  test('appear at once if frames are rare', () => {
    const sync = new TileSync();
    for (let frame = 0; frame < 60; frame++) sync.frameArrived(frame, frame * 200);
    assert.equal(sync.lateTilesWait(59 * 200 + 20), 0);
  });
});

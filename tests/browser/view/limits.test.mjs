// How far the camera goes.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { limitsOf, margins } from '../../../static/view/limits.js';
import { BOX_HEAD } from '../support/container.mjs';

describe('limits', () => {
  const scene = BOX_HEAD;

  test('a usual view box is open as far as it goes, its margins are as wide as the nearest plane moves', () => {
    const { x, y, share } = margins(scene);
    assert.equal(share, 1);
    // the nearest plane moves by f·t at the middle, and a little more at the edge of a picture that turns
    const moves = scene.intrinsics.fx * scene.viewBox.x;
    assert.ok(x > moves && x < 4 * moves + 2, `${x} for ${moves}`);
    assert.ok(y > moves && y < 4 * moves + 2, `${y} for ${moves}`);
    assert.deepEqual(limitsOf(scene), scene.viewBox);
  });

  test('a view box beyond the continued border is cut to what does not see past it', () => {
    const wide = { ...scene, viewBox: { x: 0.3, y: 0.3, z: 0.3 } };
    const { share } = margins(wide);
    assert.ok(share < 0.5 && share > 0, `${share}`);
    assert.deepEqual(limitsOf(wide), { x: 0.3 * share, y: 0.3 * share, z: 0.3 * share });
  });

  test('a camera that stands still needs no margin', () => {
    const { x, y, share } = margins({ ...scene, viewBox: { x: 0, y: 0, z: 0 } });
    assert.ok(x <= 2 && y <= 2, `${x} ${y}`);
    assert.equal(share, 1);
  });
});

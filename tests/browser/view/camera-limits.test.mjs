// Limits of the camera.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { limitsOf, margins } from '../../../static/view/camera-limits.js';
import { BOX_HEAD } from '../support/container.mjs';

describe('limits', () => {
  const scene = BOX_HEAD;

  test('a normal view box is used whole', () => {
    const { x, y, share } = margins(scene);
    assert.equal(share, 1);
    // the nearest plane moves by f·t in the middle, and a little more at the edge because the camera turns
    const moves = scene.intrinsics.fx * scene.viewBox.x;
    assert.ok(x > moves && x < 4 * moves + 2, `${x} for ${moves}`);
    assert.ok(y > moves && y < 4 * moves + 2, `${y} for ${moves}`);
    assert.deepEqual(limitsOf(scene), scene.viewBox);
  });

  test('a view box that sees past the border is reduced', () => {
    const wide = { ...scene, viewBox: { x: 0.3, y: 0.3, z: 0.3 } };
    const { share } = margins(wide);
    assert.ok(share < 0.5 && share > 0, `${share}`);
    assert.deepEqual(limitsOf(wide), { x: 0.3 * share, y: 0.3 * share, z: 0.3 * share });
  });

  test('a fixed camera needs no margin', () => {
    const { x, y, share } = margins({ ...scene, viewBox: { x: 0, y: 0, z: 0 } });
    assert.ok(x <= 2 && y <= 2, `${x} ${y}`);
    assert.equal(share, 1);
  });
});

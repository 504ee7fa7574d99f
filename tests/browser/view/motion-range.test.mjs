// Range and pivot of idle motion.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { MAX_EXTENT, motionRangeOf, overscan } from '../../../static/view/motion-range.js';
import { BOX_HEAD, boxContainer } from '../support/container.mjs';
import { decodeScene } from '../support/decoder.mjs';
import { planeScene } from '../support/layers.mjs';
import { BOX, readPng } from '../support/pictures.mjs';

/** A scene of planes with these disparities and a large view box. */
function scene(deltas, focal = 0.58) {
  const made = planeScene(deltas.map((delta) => ({ delta, alpha: 255, colour: () => [0, 0, 0] })));
  made.layers.visible.fill(100);
  const fx = focal * made.width;
  return { ...made, intrinsics: { ...made.intrinsics, fx, fy: fx }, viewBox: { x: 0.12, y: 0.12, z: 0.06 } };
}

describe('motion range', () => {
  test('the pivot is the wall, and the box is nearest', async () => {
    const box = await decodeScene(new Uint8Array(boxContainer()), readPng);
    const { pivot, nearest, travel } = motionRangeOf(box);
    assert.ok(Math.abs(pivot - BOX.far) < 0.01, `most of the picture is wall: ${pivot}`);
    assert.ok(nearest.x > BOX.x0 && nearest.x < BOX.x1 && nearest.y > BOX.y0 && nearest.y < BOX.y1, JSON.stringify(nearest));
    assert.deepEqual(travel, BOX_HEAD.viewBox, 'a small view box is used whole');
  });

  test('parallax is equal for any lens, small when flat', () => {
    const parallax = ({ travel, fx, width }, spread) => (2 * travel.x * fx * spread) / width;
    const rangeFor = (deltas, focal) => {
      const made = scene(deltas, focal);
      return { ...motionRangeOf(made), fx: made.intrinsics.fx, width: made.width };
    };
    const [wide, long] = [0.7, 1.2].map((focal) => parallax(rangeFor([0.05, 0.95], focal), 0.9));
    assert.ok(Math.abs(wide - long) < 0.002 && Math.abs(wide - 0.06) < 0.006, `${wide} ${long}`);
    const flat = rangeFor([0.4, 0.5], 0.7);
    assert.equal(flat.travel.x, MAX_EXTENT);
    assert.ok(parallax(flat, 0.1) < 0.01);
  });

  test('scenes with scattered depth move less', () => {
    const usual = motionRangeOf(scene([0.05, 0.95], 1));
    const broken = motionRangeOf(scene([0.05, 0.95, 0.1, 0.9, 0.1, 0.9], 1));
    assert.ok(broken.travel.x < usual.travel.x, `${broken.travel.x} ${usual.travel.x}`);
  });

  test('the frame zooms in to hide the border, within limits', () => {
    const { intrinsics, width } = BOX_HEAD;
    const over = overscan(BOX_HEAD, { x: 0.03, y: 0.03, z: 0.03 }, 0.5);
    const hidden = (1 - 1 / over) / 2;
    // idle motion uses three quarters of the range, and the pivot halves the shift
    assert.ok(hidden >= (0.75 * 0.5 * 0.03 * intrinsics.fx) / width && hidden < 0.025, `${hidden}`);
    assert.ok(Math.abs(overscan(BOX_HEAD, { x: 1, y: 1, z: 1 }, 0.5) - 1 / 0.95) < 1e-9);
    assert.equal(overscan(BOX_HEAD, { x: 0, y: 0, z: 0 }, 0.5), 1);
  });
});

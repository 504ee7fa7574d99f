// Camera poses and angles.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { anglesOf, extrinsics, framed, HOME, lookingAt, magnified, resized, WHOLE } from '../../../static/view/camera.js';
import { BOX_HEAD } from '../support/container.mjs';

describe('camera', () => {
  test('a frame over the whole photo is the reference camera', () => {
    const size = { width: 400, height: 240 };
    assert.deepEqual(framed(BOX_HEAD, size, WHOLE), resized(BOX_HEAD.intrinsics, BOX_HEAD, size));
    // magnified by 2 about the upper left corner
    const k = framed(BOX_HEAD, size, magnified(WHOLE, 2, { x: 0, y: 0 }));
    assert.deepEqual([k.fx, k.cx, k.cy], [4 * BOX_HEAD.intrinsics.fx, 4 * BOX_HEAD.intrinsics.cx, 4 * BOX_HEAD.intrinsics.cy]);
  });

  test('a moved camera keeps facing the pivot', () => {
    const pose = lookingAt(0.5, 0.02, 0, 0);
    assert.ok(pose.yaw < 0, 'a camera on the right looks left');
    assert.ok(Math.abs(pose.yaw + (Math.atan(0.01) * 180) / Math.PI) < 1e-9);
    assert.ok(lookingAt(0.5, 0, 0.02, 0).pitch > 0, 'a camera below looks up');
  });

  test('rotation matrices convert back to angles', () => {
    for (const angles of [
      [0, 0, 0],
      [30, -20, 10],
      [-170, 80, 179],
      [12, 90, 0],
      [-50, -90, 0],
    ]) {
      const [yaw, pitch, roll] = angles;
      const { r } = extrinsics({ ...HOME, yaw, pitch, roll });
      const transposed = [r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]];
      const again = extrinsics({ ...HOME, ...anglesOf(transposed) }).r;
      assert.ok(
        again.every((v, i) => Math.abs(v - r[i]) < 1e-9),
        `${angles}: ${again} for ${r}`,
      );
    }
  });
});

// Poses and angles.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { anglesOf, extrinsics, HOME, lookingAt, pivotOf } from '../../../static/view/camera.js';
import { boxContainer } from '../support/container.mjs';
import { scene as decoded } from '../support/decoder.mjs';
import { BOX, readPng } from '../support/pictures.mjs';

describe('camera', () => {
  test('turns about the middle', async () => {
    const scene = await decoded(new Uint8Array(boxContainer()), readPng);
    const pivot = pivotOf(scene);
    assert.ok(Math.abs(pivot - BOX.far) < 0.01, `most of the picture is wall: ${pivot}`);
  });

  test('what lies at the pivot stays in place', () => {
    const pose = lookingAt(0.5, 0.02, 0, 0);
    assert.ok(pose.yaw < 0, 'a camera on the right looks to the left');
    assert.ok(Math.abs(pose.yaw + (Math.atan(0.01) * 180) / Math.PI) < 1e-9);
    assert.ok(lookingAt(0.5, 0, 0.02, 0).pitch > 0, 'a camera below looks up');
  });

  test('angles come back from a rotation', () => {
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

// Where the camera is: limits, the owner's wishes, and poses that are held.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { CameraControl, quantised } from '../../../static/input/camera-control.js';
import { Motion } from '../../../static/input/motion.js';
import { lookingAt } from '../../../static/view/camera.js';
import { BOX_HEAD } from '../support/container.mjs';

const control = () => {
  const made = new CameraControl(new Motion());
  made.know(BOX_HEAD, null);
  return made;
};

describe('camera control', () => {
  test('before the scene is known it stands where the photo was taken', () => {
    const early = new CameraControl(new Motion());
    early.motion.jump({ x: 0.5, y: 0, z: 0 });
    assert.deepEqual(early.pose, { tx: 0, ty: 0, tz: 0, yaw: 0, pitch: 0, roll: 0 });
  });

  test('an offset is a share of the limits, and the camera keeps looking at the pivot', () => {
    const camera = control();
    camera.motion.jump({ x: 0.5, y: 0, z: 0 });
    assert.ok(Math.abs(camera.limits.x - 0.03) < 1e-9);
    assert.ok(Math.abs(camera.pose.tx - 0.5 * camera.limits.x) < 1e-9);
    assert.deepEqual(camera.pose, lookingAt(camera.pivot, camera.pose.tx, 0, 0));
  });

  test('the owner’s start is taken until somebody moves, the owner’s limits always', () => {
    const settings = { motion: { x: 0.5, y: 1, z: 1 }, start: { x: 0.25, y: 0, z: 0 }, focus: 0.6 };
    const camera = control();
    camera.obey(settings);
    assert.ok(Math.abs(camera.limits.x - 0.015) < 1e-9);
    assert.equal(camera.pivot, 0.6);
    // the start is told as a share of the whole view box
    assert.ok(Math.abs(camera.pose.tx - 0.25 * 0.03) < 1e-6, `${camera.pose.tx}`);
    const moved = control();
    moved.motion.jump({ x: 0, y: 0.1, z: 0 });
    moved.moved();
    moved.obey(settings);
    assert.equal(moved.pose.tx, 0);
    assert.ok(moved.pose.ty > 0);
  });

  test('a pose is held, beyond the limits too, until it is moved; what is no number is as at home', () => {
    const camera = control();
    camera.hold({ tx: 5, ty: NaN, yaw: 180, pitch: Infinity });
    assert.ok(camera.held);
    assert.deepEqual(camera.pose, { tx: 5, ty: 0, tz: 0, yaw: 180, pitch: 0, roll: 0 });
    assert.deepEqual(camera.coarsePose, camera.pose);
    camera.moved();
    assert.ok(!camera.held);
    assert.equal(camera.pose.tx, 0);
  });

  test('few places are asked of the server', () => {
    const seen = new Set();
    for (let i = 0; i <= 1000; i++) seen.add(quantised({ x: i / 500 - 1, y: 0, z: 0 }).x);
    assert.equal(seen.size, 25);
    assert.ok(seen.has(-1) && seen.has(0) && seen.has(1));
  });
});

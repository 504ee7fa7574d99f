// The camera's pose: limits, the owner's settings, and fixed poses.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { Motion } from '../../../static/input/camera-motion.js';
import { CameraPosition, quantised } from '../../../static/input/camera-position.js';
import { lookingAt } from '../../../static/view/camera.js';
import { BOX_HEAD } from '../support/container.mjs';

const newControl = () => {
  const made = new CameraPosition(new Motion());
  made.setScene(BOX_HEAD, null);
  return made;
};

describe('camera position', () => {
  test('starts at the reference camera', () => {
    const early = new CameraPosition(new Motion());
    early.motion.jump({ x: 0.5, y: 0, z: 0 });
    assert.deepEqual(early.pose, { tx: 0, ty: 0, tz: 0, yaw: 0, pitch: 0, roll: 0 });
  });

  test('offsets are fractions of limits; the camera faces the pivot', () => {
    const camera = newControl();
    camera.motion.jump({ x: 0.5, y: 0, z: 0 });
    assert.ok(Math.abs(camera.limits.x - 0.03) < 1e-9);
    assert.ok(Math.abs(camera.pose.tx - 0.5 * camera.limits.x) < 1e-9);
    assert.deepEqual(camera.pose, lookingAt(camera.pivot, camera.pose.tx, 0, 0));
  });

  test('the owner’s start applies until the user moves', () => {
    const settings = { motion: { x: 0.5, y: 1, z: 1 }, start: { x: 0.25, y: 0, z: 0 }, focus: 0.6 };
    const camera = newControl();
    camera.applySettings(settings);
    assert.ok(Math.abs(camera.limits.x - 0.015) < 1e-9);
    assert.equal(camera.pivot, 0.6);
    // the start is a fraction of the whole view box
    assert.ok(Math.abs(camera.pose.tx - 0.25 * 0.03) < 1e-6, `${camera.pose.tx}`);
    const moved = newControl();
    moved.motion.jump({ x: 0, y: 0.1, z: 0 });
    moved.moved();
    moved.applySettings(settings);
    assert.equal(moved.pose.tx, 0);
    assert.ok(moved.pose.ty > 0);
  });

  test('a fixed pose may exceed limits; invalid numbers are 0', () => {
    const camera = newControl();
    camera.holdPose({ tx: 5, ty: NaN, yaw: 180, pitch: Infinity });
    assert.ok(camera.holdsPose);
    assert.deepEqual(camera.pose, { tx: 5, ty: 0, tz: 0, yaw: 180, pitch: 0, roll: 0 });
    assert.deepEqual(camera.quantisedPose, camera.pose);
    camera.moved();
    assert.ok(!camera.holdsPose);
    assert.equal(camera.pose.tx, 0);
  });

  test('poses for the server are quantised', () => {
    const seen = new Set();
    for (let i = 0; i <= 1000; i++) seen.add(quantised({ x: i / 500 - 1, y: 0, z: 0 }).x);
    assert.equal(seen.size, 25);
    assert.ok(seen.has(-1) && seen.has(0) && seen.has(1));
  });
});

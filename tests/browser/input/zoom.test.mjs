// Zoom.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { Zoom } from '../../../static/input/zoom.js';

const near = (a, b, what) => assert.ok(Math.abs(a - b) < 1e-6, `${what}: ${a}, not ${b}`);
/** A wide photo in a square area: 4000 pixels on 1000 screen pixels. */
const panorama = () => {
  const zoom = new Zoom();
  zoom.measure({ width: 1000, height: 1000 }, { width: 1000, height: 200 }, 4);
  return zoom;
};
/** Position in the photo, as fractions, at an offset in CSS pixels from the middle. */
const photoPoint = ({ now: { scale, x, y } }, at) => ({ x: x + at.x / (1000 * scale), y: y + at.y / (200 * scale) });

describe('zoom', () => {
  test('the point under the pointer stays in place', () => {
    const zoom = panorama();
    const at = { x: 300, y: -40 };
    const before = photoPoint(zoom, at);
    zoom.by(3, at);
    let frames = 0;
    while (zoom.step(1 / 60)) {
      near(photoPoint(zoom, at).x, before.x, 'during the animation');
      frames++;
    }
    assert.ok(frames > 5 && frames < 120, `${frames}`);
    near(zoom.now.scale, 3, 'scale');
    near(photoPoint(zoom, at).x, before.x, 'at the end');
  });

  test('a panorama fills the area and shows no border', () => {
    const zoom = panorama();
    assert.deepEqual(zoom.size, { width: 1000, height: 200 });
    assert.deepEqual(zoom.frame, { scale: 1, x: 0.5, y: 0.5 });
    zoom.by(2, { x: 0, y: 0 });
    zoom.settle();
    assert.deepEqual(zoom.size, { width: 1000, height: 400 });
    assert.deepEqual(zoom.frame, { scale: 2, x: 0.5, y: 0.5 });
    zoom.by(4, { x: 0, y: 0 });
    zoom.settle();
    assert.deepEqual(zoom.size, { width: 1000, height: 1000 });
    zoom.pan(1e6, -1e6);
    near(zoom.now.x, 1 / 16, 'the left border');
    near(zoom.now.y, 1 - 1000 / (2 * 200 * 8), 'the lower border');
  });

  test('zoom ends at twice the photo’s resolution', () => {
    const zoom = panorama();
    zoom.by(1e9, { x: 10, y: 10 });
    assert.equal(zoom.target.scale, 8);
    zoom.by(1e-9, { x: 500, y: 0 });
    assert.deepEqual(zoom.target, { scale: 1, x: 0.5, y: 0.5 });
    const small = new Zoom();
    small.measure({ width: 1000, height: 1000 }, { width: 1000, height: 1000 }, 0.2);
    assert.equal(small.most, 3, 'small photos can be enlarged too');
  });

  test('a double tap toggles the photo’s full resolution', () => {
    const zoom = panorama();
    zoom.toggle({ x: -200, y: 0 });
    assert.equal(zoom.target.scale, 4);
    zoom.toggle({ x: 0, y: 0 });
    assert.deepEqual(zoom.target, { scale: 1, x: 0.5, y: 0.5 });
  });
});

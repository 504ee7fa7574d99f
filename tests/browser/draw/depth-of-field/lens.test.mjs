// The blurred picture against a thin lens: what lies out of focus spreads evenly over a disc.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { DepthOfField } from '../../../../static/draw/depth-of-field/aperture.js';
import { HOME } from '../../../../static/view/camera.js';

const SIZE = 64;
/** Radius of the aperture at full blur, in units of the nearest distance. */
const APERTURE = 0.015;
/** Few of the 64 samples of a disc may lie on the wrong side of a line. */
const SAMPLES = 4 / 64;

/** The part of a unit disc on one side of a line at `at`. */
function discBelow(at) {
  const t = Math.max(-1, Math.min(1, at));
  return 0.5 + (Math.asin(t) + t * Math.sqrt(1 - t * t)) / Math.PI;
}

/** Draws an edge straight ahead at disparity `delta`: white right of it, or below it. */
function edge(delta, axis) {
  return {
    readPixels({ tx, ty }, k, width, height) {
      const [at, shift] = axis === 'x' ? [k.cx, -k.fx * tx * delta] : [k.cy, -k.fy * ty * delta];
      const covered = (v) => 255 * Math.max(0, Math.min(1, v + 1 - (at + shift)));
      return Array.from({ length: 4 * width * height }, (_, i) => {
        const pixel = i >> 2;
        return covered(axis === 'x' ? pixel % width : Math.floor(pixel / width));
      });
    },
  };
}

describe('thin lens', () => {
  for (const axis of ['x', 'y']) {
    for (const [delta, focus, blur] of [
      [0.9, 0.1, 1],
      [0, 1, 0.5],
      [0.4, 0.9, 1],
      [0.7, 0.7, 1],
      [0, 0, 1],
      [1, 0, 0.001],
    ]) {
      test(`an edge along ${axis} at disparity ${delta} with ${focus} in focus, blur ${blur}`, async () => {
        const lens = Object.assign(new DepthOfField(), { blur, focus });
        const k = { fx: 1000, fy: 1400, cx: SIZE / 2, cy: SIZE / 2 };
        const pixels = await lens.pixels(edge(delta, axis), { pose: HOME, k, x: 0, width: SIZE, height: SIZE }, 0.5);
        const radius = (axis === 'x' ? k.fx : k.fy) * APERTURE * blur * Math.abs(delta - focus);
        for (let i = 0; i < SIZE; i++) {
          const got = pixels[4 * (axis === 'x' ? 5 * SIZE + i : i * SIZE + 5)] / 255;
          // the mean over the pixel
          const parts = Array.from({ length: 16 }, (_, j) => i + (j + 0.5) / 16 - SIZE / 2);
          const want = parts.reduce((sum, v) => sum + (radius > 0 ? discBelow(v / radius) : Number(v > 0)), 0) / 16;
          assert.ok(Math.abs(got - want) <= SAMPLES, `pixel ${i}: ${got}, of a lens ${want}`);
        }
      });
    }
  }
});

// Stacked soft layers: their order for cameras that look forward and backward, and blending with more than 8 bits.
import assert from 'node:assert/strict';
import { before, describe, test } from 'node:test';
import { pieces } from '../../../static/draw/border.js';
import { hasDeepStacks } from '../../../static/draw/deep-stacks.js';
import { halfBits, premultipliedHalves } from '../../../static/draw/half-float.js';
import { openPage } from '../support/browser.mjs';
import { assembledPlaneScene, composite, drawScene, planeScene } from '../support/layers.mjs';
import { boxSuite } from '../support/suite.mjs';

const MODES = ['gpu', 'webgl'];
/** Behind both layers, looking back to the reference camera. */
const BEHIND = { tz: 8, yaw: 180 };

/** Largest difference between drawn and composited pixels in the middle of the picture. */
function worst(pixels, planes, { width, height }) {
  let most = 0;
  for (let y = height / 4; y < (3 * height) / 4; y++) {
    for (let x = width / 4; x < (3 * width) / 4; x++) {
      composite(planes, x, y).forEach((want, c) => (most = Math.max(most, Math.abs(pixels[(y * width + x) * 4 + c] - want))));
    }
  }
  return most;
}

describe('soft layers', () => {
  const suite = boxSuite();
  const far = { delta: 0.25, alpha: 128, colour: () => [250, 20, 20] };
  const near = { delta: 0.5, alpha: 128, colour: () => [20, 20, 250] };

  let page;
  let errors;
  before(async () => {
    ({ page, errors } = await openPage(suite.browser));
    await page.goto(`${suite.server.url}/embed/blank`);
  });

  for (const mode of MODES) {
    test(`a camera that looks back sees the opposite order (${mode})`, async (t) => {
      const scene = await assembledPlaneScene(t, [far, near]);
      const forward = await drawScene(page, mode, scene, {});
      assert.ok(worst(forward.pixels, [far, near], scene) < 1.5, 'the near layer covers the far one');
      const backward = await drawScene(page, mode, scene, BEHIND);
      const middle = (scene.height / 2) * scene.width + scene.width / 2;
      const got = [...backward.pixels.subarray(middle * 4, middle * 4 + 4)];
      composite([near, far], 0, 0).forEach((want, c) =>
        assert.ok(Math.abs(got[c] - want) < 1.5, `${got}, not ${composite([near, far], 0, 0)}`),
      );
      assert.deepEqual(errors, []);
    });

    test(`a stack of thin layers blends precisely (${mode})`, async (t) => {
      const thin = (i) => ({
        delta: 0.1 * (i + 1),
        alpha: 20,
        colour: (x, y) => [0, 1, 2].map((c) => (37 * x + 59 * y + 83 * i + 101 * c) % 256),
      });
      const planes = Array.from({ length: 8 }, (_, i) => thin(i));
      const scene = await assembledPlaneScene(t, planes);
      const { pixels, wide } = await drawScene(page, mode, scene, {});
      assert.ok(wide);
      const most = worst(pixels, planes, scene);
      t.diagnostic(`at most ${most.toFixed(3)} levels off`);
      // rounding the final picture costs half a level
      assert.ok(most < 0.7, `${most} levels`);
      const few = await assembledPlaneScene(t, planes.slice(4));
      assert.equal((await drawScene(page, mode, few, {})).wide, false, 'four layers need only 8 bits');
      assert.deepEqual(errors, []);
    });
  }

  test('stacks are counted across tile borders', () => {
    const deep = (scene) => hasDeepStacks(scene, scene.layers, scene.alpha, pieces(scene));
    const scene = planeScene([far, far, far, near, near, near]);
    const one = { ...scene, layers: { ...scene.layers, count: 3 } };
    assert.equal(deep(one), false);
    // the last three belong to a neighbouring tile that overlaps the first by eight pixels
    const two = { ...scene, width: 88, tileSize: 48, tileStride: 40, layers: structuredClone(scene.layers) };
    for (const i of [3, 4, 5]) two.layers.tileX[i] = two.layers.x[i] = 40;
    assert.ok(deep(two));
    const apart = { ...two, tileStride: 48, width: 96, layers: structuredClone(two.layers) };
    for (const i of [3, 4, 5]) apart.layers.tileX[i] = apart.layers.x[i] = 48;
    assert.equal(deep(apart), false);
  });

  test('conversion to 16-bit floats rounds to nearest', () => {
    for (const [value, bits] of [
      [0, 0],
      [1, 0x3c00],
      [0.5, 0x3800],
      [1 / 3, 0x3555],
      [2 ** -14, 0x0400],
      [2 ** -24, 1],
      [0.99999, 0x3c00],
    ]) {
      assert.equal(halfBits(value), bits, `${value}`);
    }
    const value = (bits) => (bits < 0x400 ? bits * 2 ** -24 : (1024 + (bits & 1023)) * 2 ** ((bits >> 10) - 25));
    premultipliedHalves().forEach((bits, i) => {
      const want = ((i >> 8) * (i & 255)) / 65_025;
      const off = Math.abs(value(bits) - want);
      assert.ok(off <= Math.abs(value(bits + 1) - want) && (bits === 0 || off <= Math.abs(value(bits - 1) - want)), `${want}`);
    });
  });
});

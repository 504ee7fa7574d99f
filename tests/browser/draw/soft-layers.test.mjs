// Soft layers over each other: their order for cameras that look forward and backward, and sums finer than 8 bits.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { pieces } from '../../../static/draw/border.js';
import { halfBits, premultipliedHalves } from '../../../static/draw/half-float.js';
import { hasDeepStacks } from '../../../static/draw/soft-stacks.js';
import { openPage } from '../support/browser.mjs';
import { drawn, layerScene, layersOf, over } from '../support/layers.mjs';
import { boxSuite } from '../support/suite.mjs';

const MODES = ['gpu', 'webgl'];
/** Beyond both layers, with the back to where the photo was taken. */
const BEHIND = { tz: 8, yaw: 180 };

/** The greatest difference between drawn pixels and planes over each other, over the middle of the picture. */
function worst(pixels, planes, { width, height }) {
  let most = 0;
  for (let y = height / 4; y < (3 * height) / 4; y++) {
    for (let x = width / 4; x < (3 * width) / 4; x++) {
      over(planes, x, y).forEach((want, c) => (most = Math.max(most, Math.abs(pixels[(y * width + x) * 4 + c] - want))));
    }
  }
  return most;
}

describe('soft layers', () => {
  const suite = boxSuite();
  const far = { delta: 0.25, alpha: 128, colour: () => [250, 20, 20] };
  const near = { delta: 0.5, alpha: 128, colour: () => [20, 20, 250] };

  for (const mode of MODES) {
    test(`a camera that looks backward sees them in the opposite order (${mode})`, async (t) => {
      const { page, context, errors } = await openPage(suite.browser);
      await page.goto(`${suite.server.url}/embed/blank`);
      const scene = await layerScene(t, [far, near]);
      const forward = await drawn(page, mode, scene, {});
      assert.ok(worst(forward.pixels, [far, near], scene) < 1.5, 'the near one lies over the far one');
      const backward = await drawn(page, mode, scene, BEHIND);
      const middle = (scene.height / 2) * scene.width + scene.width / 2;
      const got = [...backward.pixels.subarray(middle * 4, middle * 4 + 4)];
      over([near, far], 0, 0).forEach((want, c) => assert.ok(Math.abs(got[c] - want) < 1.5, `${got}, not ${over([near, far], 0, 0)}`));
      assert.deepEqual(errors, []);
      await context.close();
    });

    test(`a stack of thin layers is as exact as one (${mode})`, async (t) => {
      const { page, context, errors } = await openPage(suite.browser);
      await page.goto(`${suite.server.url}/embed/blank`);
      const thin = (i) => ({
        delta: 0.1 * (i + 1),
        alpha: 20,
        colour: (x, y) => [0, 1, 2].map((c) => (37 * x + 59 * y + 83 * i + 101 * c) % 256),
      });
      const planes = Array.from({ length: 8 }, (_, i) => thin(i));
      const scene = await layerScene(t, planes);
      const { pixels, wide } = await drawn(page, mode, scene, {});
      assert.ok(wide);
      const most = worst(pixels, planes, scene);
      t.diagnostic(`at most ${most.toFixed(3)} levels off`);
      // half a level is what rounding the finished picture takes
      assert.ok(most < 0.7, `${most} levels`);
      const few = await layerScene(t, planes.slice(4));
      assert.equal((await drawn(page, mode, few, {})).wide, false, 'four layers need no more than bytes');
      assert.deepEqual(errors, []);
      await context.close();
    });
  }

  test('stacks are counted over the borders of tiles', () => {
    const deep = (scene) => hasDeepStacks(scene, scene.layers, scene.alpha, pieces(scene));
    const scene = layersOf([far, far, far, near, near, near]);
    const one = { ...scene, layers: { ...scene.layers, count: 3 } };
    assert.equal(deep(one), false);
    // the last three belong to a tile beside, whose pixels overlap those of the first by eight
    const two = { ...scene, width: 88, tileSize: 48, tileStride: 40, layers: structuredClone(scene.layers) };
    for (const i of [3, 4, 5]) two.layers.tileX[i] = two.layers.x[i] = 40;
    assert.ok(deep(two));
    const apart = { ...two, tileStride: 48, width: 96, layers: structuredClone(two.layers) };
    for (const i of [3, 4, 5]) apart.layers.tileX[i] = apart.layers.x[i] = 48;
    assert.equal(deep(apart), false);
  });

  test('16-bit floats are the nearest ones', () => {
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

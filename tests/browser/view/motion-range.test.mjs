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

/**
 * Reference: the rules on a list of all visible texels, each at its layer's disparity, from far to near. A test of
 * crates/render/src/motion_range.rs compares it with the same.
 */
function byDefinition({ width, height, tileSize, intrinsics, viewBox, layers }) {
  const texels = [];
  for (let i = 0; i < layers.count; i++) {
    const [x, y] = [layers.x[i] + layers.w[i] / 2, layers.y[i] + layers.h[i] / 2];
    const delta = layers.a[i] + layers.b[i] * ((2 * x) / tileSize - 1) + layers.c[i] * ((2 * y) / tileSize - 1);
    const bin = Number.isNaN(delta) ? 0 : Math.min(255, Math.max(0, Math.floor(delta * 256)));
    for (let k = 0; k < layers.visible[i]; k++) texels.push({ delta: (bin + 0.5) / 256, x, y });
  }
  texels.sort((a, b) => a.delta - b.delta);
  const at = (share) => texels[Math.max(0, Math.ceil(share * texels.length) - 1)].delta;
  const [spread, count] = texels.length ? [at(0.97) - at(0.03), layers.count] : [0.8, 0];
  const wanted = ((0.06 * width) / (2 * intrinsics.fx * Math.max(spread, 0.001))) * Math.max(1 - 0.15 * Math.max(count - 4, 0), 0.6);
  const half = Math.min(0.06, Math.max(0.02, wanted));
  const nearest = texels.filter(({ delta }) => delta >= at(0.97));
  const mean = (of, side) => (nearest.length ? nearest.reduce((sum, t) => sum + of(t), 0) / nearest.length / side : 0.5);
  return {
    travel: { x: Math.min(viewBox.x, half), y: Math.min(viewBox.y, half), z: Math.min(viewBox.z, 2 * half) },
    pivot: texels.length ? at(0.5) : 0.35,
    nearest: { x: mean((t) => t.x, width), y: mean((t) => t.y, height) },
  };
}

describe('motion range', () => {
  test('agrees with its definition for any planes, also without visible texels', () => {
    let state = 1;
    const below = (n) => {
      state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
      return (state / 2 ** 32) * n;
    };
    const wild = [Number.NaN, Number.POSITIVE_INFINITY, Number.NEGATIVE_INFINITY];
    for (let n = 0; n < 200; n++) {
      const made = scene(
        Array.from({ length: Math.floor(below(9)) }, () => (below(9) < 1 ? wild[Math.floor(below(3))] : below(1.6) - 0.3)),
      );
      const { layers, width, height } = made;
      for (let i = 0; i < layers.count; i++) {
        [layers.b[i], layers.c[i]] = [below(0.6) - 0.3, below(0.6) - 0.3];
        [layers.x[i], layers.y[i], layers.w[i], layers.h[i]] = [below(width), below(height), 1 + below(width), 1 + below(height)];
        // equal counts end at a quantile exactly
        layers.visible[i] = n % 10 ? (n % 3 ? below(300) : 100) : 0;
      }
      made.intrinsics.fx = 10 + below(300);
      const [got, want] = [motionRangeOf(made), byDefinition(made)];
      const flat = ({ travel, pivot, nearest }) => [travel.x, travel.y, travel.z, pivot, nearest.x, nearest.y];
      const wants = flat(want);
      assert.ok(
        flat(got).every((v, i) => Math.abs(v - wants[i]) < 1e-9),
        `scene ${n}: ${JSON.stringify(got)}, not ${JSON.stringify(want)}`,
      );
    }
  });

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

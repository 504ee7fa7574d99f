// How far a photo moves by itself, and about what.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { MOST, outlookOf, overscan } from '../../../static/view/outlook.js';
import { BOX_HEAD, boxContainer } from '../support/container.mjs';
import { scene as decoded } from '../support/decoder.mjs';
import { layersOf } from '../support/layers.mjs';
import { BOX, readPng } from '../support/pictures.mjs';

/** Planes beside each other, each of so many texels, in a view box that is wide enough. */
function scene(deltas, focal = 0.58) {
  const made = layersOf(deltas.map((delta) => ({ delta, alpha: 255, colour: () => [0, 0, 0] })));
  made.layers.visible.fill(100);
  const fx = focal * made.width;
  return { ...made, intrinsics: { ...made.intrinsics, fx, fy: fx }, viewBox: { x: 0.12, y: 0.12, z: 0.06 } };
}

describe('outlook', () => {
  test('turns about the middle, and knows where the nearest things are', async () => {
    const box = await decoded(new Uint8Array(boxContainer()), readPng);
    const { pivot, nearest, travel } = outlookOf(box);
    assert.ok(Math.abs(pivot - BOX.far) < 0.01, `most of the picture is wall: ${pivot}`);
    assert.ok(nearest.x > BOX.x0 && nearest.x < BOX.x1 && nearest.y > BOX.y0 && nearest.y < BOX.y1, JSON.stringify(nearest));
    assert.deepEqual(travel, BOX_HEAD.viewBox, 'a small view box is used whole');
  });

  test('near against far moves by the same share whatever the lens; what is flat moves little', () => {
    const way = ({ travel, fx, width }, spread) => (2 * travel.x * fx * spread) / width;
    const of = (deltas, focal) => {
      const made = scene(deltas, focal);
      return { ...outlookOf(made), fx: made.intrinsics.fx, width: made.width };
    };
    const [wide, long] = [0.7, 1.2].map((focal) => way(of([0.05, 0.95], focal), 0.9));
    assert.ok(Math.abs(wide - long) < 0.002 && Math.abs(wide - 0.06) < 0.006, `${wide} ${long}`);
    const flat = of([0.4, 0.5], 0.7);
    assert.equal(flat.travel.x, MOST);
    assert.ok(way(flat, 0.1) < 0.01);
  });

  test('broken depth moves less', () => {
    const usual = outlookOf(scene([0.05, 0.95], 1));
    const broken = outlookOf(scene([0.05, 0.95, 0.1, 0.9, 0.1, 0.9], 1));
    assert.ok(broken.travel.x < usual.travel.x, `${broken.travel.x} ${usual.travel.x}`);
  });

  test('the frame comes closer by what idle motion sees past the border, and no more than a little', () => {
    const { intrinsics, width } = BOX_HEAD;
    const over = overscan(BOX_HEAD, { x: 0.03, y: 0.03, z: 0.03 }, 0.5);
    const hidden = (1 - 1 / over) / 2;
    // idle motion goes three quarters of the way, and half of that is what stays in place
    assert.ok(hidden >= (0.75 * 0.5 * 0.03 * intrinsics.fx) / width && hidden < 0.025, `${hidden}`);
    assert.ok(Math.abs(overscan(BOX_HEAD, { x: 1, y: 1, z: 1 }, 0.5) - 1 / 0.95) < 1e-9);
    assert.equal(overscan(BOX_HEAD, { x: 0, y: 0, z: 0 }, 0.5), 1);
  });
});

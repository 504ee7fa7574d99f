// Instance data for the shaders.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { mirrorFlags, pieces } from '../../../static/draw/border.js';
import { INSTANCE_FLOATS, instances, withErrors } from '../../../static/draw/instances.js';
import { pack } from '../../../static/draw/texture-atlas.js';
import { boxContainer } from '../support/container.mjs';
import { decodeScene } from '../support/decoder.mjs';
import { readPng } from '../support/pictures.mjs';

describe('instances', async () => {
  const scene = await decodeScene(new Uint8Array(boxContainer()), readPng);
  const all = pieces(scene);
  const places = pack(all);
  /** Instance `i`, named as in tmpi.wgsl. */
  const read = (data, i) => {
    const [a, b, c, page, cx, cy, x, y, w, h] = data.subarray(i * INSTANCE_FLOATS, (i + 1) * INSTANCE_FLOATS);
    return { a, b, c, page, cx, cy, x, y, w, h };
  };
  const delta = ({ a, b, c, cx, cy, x, y, w, h }) => a + (b * (x + w / 2 - cx) + c * (y + h / 2 - cy)) / (scene.tileSize / 2);

  test('lists all pieces in order, then soft pieces back to front', () => {
    const { data, opaque, soft } = instances(scene, all, places);
    assert.equal(opaque, all.length);
    assert.equal(soft, all.filter((p) => scene.layers.soft[p.layer]).length);
    assert.ok(soft > 10, `${soft} soft pieces`);
    all.forEach((p, i) => assert.deepEqual([read(data, i).x, read(data, i).y], [p.x + p.left, p.y + p.upper]));
    for (let i = 1; i < soft; i++) assert.ok(delta(read(data, opaque + i - 1)) <= delta(read(data, opaque + i)) + 1e-6, `${i}`);
  });

  test('names the borders at which a piece is mirrored', () => {
    const flags = (/** @type {number} */ x, /** @type {number} */ y, flipX = false, flipY = false) => mirrorFlags({ x, y, flipX, flipY });
    assert.deepEqual([flags(-5, 3, true), flags(100, 3, true), flags(3, -5, false, true), flags(3, 60, false, true)], [1, 5, 2, 10]);
    assert.deepEqual([flags(-5, 60, true, true), flags(3, 3)], [11, 0]);
  });

  test('stores a tile’s error as a fraction of the page', () => {
    const errors = [0, 0.5, 7];
    const { data } = withErrors(instances(scene, all, places), errors);
    const shares = new Map();
    all.forEach((p, i) => shares.set(scene.layers.tileX[p.layer] + scene.layers.tileY[p.layer] * 1000, read(data, i).page % 1));
    const [first, second, third] = [0, 56, 112].map((x) => shares.get(x));
    assert.equal(first, 0);
    assert.ok(Math.abs(second - 0.5) < 0.01, `${second}`);
    assert.ok(third > 0.99 && third < 1, `${third}`);
  });
});

// Places of pieces on the pages of the texture array, and what is written there.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { decode } from '../../../static/decode/container.js';
import { pieces } from '../../../static/draw/border.js';
import { expandAll, pack } from '../../../static/draw/texture-atlas.js';
import { boxScene, container } from '../support/container.mjs';
import { readPng } from '../support/pictures.mjs';

/** Sizes from a generator with a fixed seed. */
function sizes(count, most) {
  let seed = 7;
  const random = () => {
    seed = (seed * 48_271) % 2_147_483_647;
    return 1 + (seed % most);
  };
  return Array.from({ length: count }, () => ({ w: random(), h: random() }));
}

describe('texture atlas', () => {
  test('pieces lie on their pages without overlap', () => {
    const all = sizes(300, 70);
    const { page, atlasX, atlasY, width, height, pages } = pack(all, 256, 64);
    assert.ok(pages > 1 && width <= 256 && height <= 256);
    const taken = new Set();
    all.forEach(({ w, h }, i) => {
      assert.ok(page[i] < pages && atlasX[i] + w <= width && atlasY[i] + h <= height, `piece ${i}`);
      for (let y = atlasY[i]; y < atlasY[i] + h; y++) {
        for (let x = atlasX[i]; x < atlasX[i] + w; x++) {
          const at = (page[i] * height + y) * width + x;
          assert.ok(!taken.has(at), `two pieces at ${x}, ${y} of page ${page[i]}`);
          taken.add(at);
        }
      }
    });
  });

  test('what does not fit is refused', () => {
    assert.equal(pack([{ w: 100, h: 10 }], 100, 1).pages, 1);
    assert.throws(() => pack([{ w: 101, h: 10 }], 100, 1), /does not fit/);
    const two = [
      { w: 100, h: 100 },
      { w: 100, h: 100 },
    ];
    assert.equal(pack(two, 100, 2).pages, 2);
    assert.throws(() => pack(two, 100, 1), /do not fit/);
  });

  test('the texels written are those of the layers, premultiplied, and mirrored beyond the border', async () => {
    const scene = await decode(new Uint8Array(container(boxScene())), async ({ bytes }) => readPng(bytes));
    const all = pieces(scene);
    assert.ok(all.some((p) => p.flipX) && all.some((p) => p.flipY), 'the scene goes on beyond its border');
    const places = pack(all, 2048, 16);
    const atlas = new Uint8Array(places.width * places.height * places.pages * 4);
    await expandAll(scene, all, places.bands, places.width, (band, data) =>
      atlas.set(data, (band.page * places.height + band.y) * places.width * 4),
    );
    const { layers, classes, alpha, photo } = scene;
    let looked = 0;
    all.forEach((p, i) => {
      for (let v = 0; v < p.h; v++) {
        for (let u = 0; u < p.w; u++) {
          const [x, y] = [p.u + (p.flipX ? p.w - 1 - u : u), p.v + (p.flipY ? p.h - 1 - v : v)];
          const texel = layers.firstTexel[p.layer] + y * layers.w[p.layer] + x;
          const at = ((places.page[i] * places.height + places.atlasY[i] + v) * places.width + places.atlasX[i] + u) * 4;
          assert.equal(atlas[at + 3], classes[texel] ? alpha[texel] : 0);
          if (classes[texel] !== 1) continue;
          const from = ((layers.y[p.layer] + y) * scene.width + layers.x[p.layer] + x) * 4;
          for (let c = 0; c < 3; c++) assert.equal(atlas[at + c], Math.round((photo.data[from + c] * alpha[texel]) / 255));
          looked++;
        }
      }
    });
    assert.ok(looked > 20_000, `${looked} texels`);
  });
});

// Positions of pieces on the pages of the texture array, and the texels there.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { describe, test } from 'node:test';
import { readHead } from '../../../static/decode/head.js';
import { pieces } from '../../../static/draw/border.js';
import { INSTANCE_FLOATS } from '../../../static/draw/instances.js';
import { checkFit, pack, upload } from '../../../static/draw/texture-atlas.js';
import { decodeScene, decodeTexels } from '../support/decoder.mjs';

/** Pseudo-random sizes from a fixed seed. */
function sizes(count, most) {
  let seed = 7;
  const random = () => {
    seed = (seed * 48_271) % 2_147_483_647;
    return 1 + (seed % most);
  };
  return Array.from({ length: count }, () => ({ w: random(), h: random() }));
}

describe('texture atlas', () => {
  test('pieces do not overlap, and groups have separate strips', () => {
    const two = Array.from({ length: 3000 }, (_, i) => Number(i > 1700));
    for (const [groups, most] of [[undefined], [two], [two, 2048], [undefined, 1000]]) {
      const all = sizes(3000, 170);
      const { page, atlasX, atlasY, width, height, pages, bands } = pack(all, groups, most);
      const side = most ?? 4096;
      assert.ok(pages > 1 && width <= side && height <= side, `${pages} pages of ${width} × ${height}`);
      const rows = new Map();
      all.forEach(({ w, h }, i) => {
        assert.ok(page[i] < pages && atlasX[i] + w <= width && atlasY[i] + h <= height, `piece ${i}`);
        const strip = bands.find((band) => band.pieces.includes(i));
        assert.ok(strip && strip.page === page[i] && strip.y === atlasY[i] && h <= strip.h, `piece ${i}`);
        assert.ok(!groups || strip.pieces.every((other) => groups[other] === groups[i]), `piece ${i}`);
        rows.set(strip, [...(rows.get(strip) ?? []), [atlasX[i], atlasX[i] + w]]);
      });
      for (const places of rows.values()) {
        places.sort((p, q) => p[0] - q[0]);
        for (let k = 1; k < places.length; k++) assert.ok(places[k - 1][1] <= places[k][0], 'two pieces overlap');
      }
      const strips = bands.toSorted((p, q) => p.page - q.page || p.y - q.y);
      for (let k = 1; k < strips.length; k++) {
        assert.ok(strips[k - 1].page < strips[k].page || strips[k - 1].y + strips[k - 1].h <= strips[k].y, 'two strips overlap');
      }
    }
  });

  test('an atlas that exceeds the device limits is rejected', () => {
    assert.equal(pack([{ w: 5000, h: 10 }]).width, 5000);
    const atlas = { width: 5000, height: 10, pages: 2, wide: false, strips: [] };
    checkFit(atlas, { side: 5000, pages: 2 });
    for (const most of [
      { side: 4999, pages: 2 },
      { side: 5000, pages: 1 },
    ]) {
      assert.throws(() => checkFit(atlas, most), /do not fit/);
    }
  });

  test('strips upload in parts that never fill the queue', async () => {
    const width = 2048;
    const strip = (page, y, h) => ({ page, y, h, data: Uint8Array.from({ length: width * 4 * h }, (_, i) => (i + page * 3 + y) & 255) });
    // one strip is taller than a part, one ends within a part
    const strips = [strip(0, 0, 1500), strip(0, 1500, 64), strip(1, 0, 257)];
    const seen = strips.map(() => []);
    let [queued, most, parts] = [0, 0, 0];
    const write = ({ page, y, h, data }) => {
      assert.ok(data.byteLength === width * 4 * h && data.byteLength <= 2 << 20, `${data.byteLength} bytes at once`);
      const own = strips.findIndex((s) => s.page === page && s.y <= y && y + h <= s.y + s.h);
      seen[own].push(data);
      queued += data.byteLength;
      most = Math.max(most, queued);
      parts++;
    };
    const settle = async () => {
      queued = 0;
    };
    await upload({ width, height: 1564, pages: 2, wide: false, strips }, write, settle);
    strips.forEach(({ data }, i) => assert.ok(Buffer.concat(seen[i]).equals(Buffer.from(data)), `strip ${i}`));
    assert.ok(parts > strips.length && most <= 10 << 20, `${parts} parts, ${most} bytes queued`);
  });

  /** Colours beyond the border, for each number of bands. @type {number[][]} */
  const beyond = [];
  for (const count of [1, 2]) {
    test(`pages contain premultiplied texels, with other colours beyond the border (bands: ${count})`, async () => {
      const bytes = new Uint8Array(readFileSync(new URL('../../golden/v1_bands.tmpi', import.meta.url)));
      const { width, height } = readHead(bytes).scene;
      const photo = { width, height, data: Uint8Array.from({ length: width * height * 4 }, (_, i) => (i * 7 + (i >> 9)) & 255) };
      const scene = await decodeScene(bytes, async () => photo, count);
      const all = pieces(scene);
      assert.ok(all.some((p) => p.flipX) && all.some((p) => p.flipY), 'the scene continues beyond its border');
      const { atlas, layers } = scene;
      const pages = new Uint8Array(atlas.width * atlas.height * atlas.pages * 4);
      for (const strip of atlas.strips) pages.set(strip.data, (strip.page * atlas.height + strip.y) * atlas.width * 4);
      const { classes, alpha, hidden } = await decodeTexels(bytes, { photo });
      const checked = [0, 0, 0];
      /** @type {number[]} */
      const continued = [];
      let [visible, mirrored] = [0, 0];
      const starts = [];
      const ranks = [];
      let [texel, rank] = [0, 0];
      for (let i = 0; i < layers.count; i++) {
        starts.push(texel);
        for (let k = 0; k < layers.w[i] * layers.h[i]; k++, texel++) {
          ranks.push(rank);
          if (classes[texel] === 2) rank++;
        }
      }
      all.forEach((p, i) => {
        const { instances } = scene;
        const [page, left, upper] = [3, 10, 11].map((k) => instances.data[i * INSTANCE_FLOATS + k]);
        const [atlasX, atlasY] = [left - p.left, upper - p.upper];
        for (let v = 0; v < p.h; v++) {
          for (let u = 0; u < p.w; u++) {
            const [x, y] = [p.u + (p.flipX ? p.w - 1 - u : u), p.v + (p.flipY ? p.h - 1 - v : v)];
            const texel = starts[p.layer] + y * layers.w[p.layer] + x;
            const at = ((page * atlas.height + atlasY + v) * atlas.width + atlasX + u) * 4;
            const kind = classes[texel];
            checked[kind]++;
            assert.equal(pages[at + 3], kind ? alpha[texel] : 0);
            const from = ((layers.y[p.layer] + y) * width + layers.x[p.layer] + x) * 4;
            const source = kind === 1 ? photo.data.subarray(from) : hidden.subarray(ranks[texel] * 3);
            for (let c = 0; c < 3; c++) {
              const want = kind ? Math.round((source[c] * alpha[texel]) / 255) : 0;
              if (kind && (p.flipX || p.flipY)) {
                continued.push(pages[at + c]);
                visible += Number(kind === 1);
                mirrored += Number(kind === 1 && pages[at + c] === want);
              } else assert.equal(pages[at + c], want);
            }
          }
        }
      });
      assert.ok(
        checked.every((n) => n > 1000),
        `${checked} texels`,
      );
      assert.ok(mirrored < visible / 4, `${mirrored} of ${visible} colours beyond the border are mirrored`);
      beyond.push(continued);
      assert.deepEqual(continued, beyond[0], 'all bands continue the same');
    });
  }
});

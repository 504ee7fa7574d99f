// The container's decoder, without a browser.
import assert from 'node:assert/strict';
import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { describe, test } from 'node:test';
import { detached, work } from '../../../static/decode/bands.js';
import { Class, ContainerError, decode, endOfSection, Kind, readIndex } from '../../../static/decode/container.js';
import { tileCounts } from '../../../static/decode/grid.js';
import { crc32 } from '../../../static/decode/labels.js';
import { boxScene, container } from '../support/container.mjs';
import { readPng, wall } from '../support/pictures.mjs';

const decodePicture = async ({ bytes, type }) => {
  assert.equal(type, 'image/png');
  return readPng(bytes);
};
const scene = boxScene();
const bytes = new Uint8Array(container(scene));

/** A container with one thing changed. */
const altered = (change) => new Uint8Array(container(scene, { change }));
const refuses = (data, pattern) =>
  assert.rejects(decode(data, decodePicture), (error) => {
    assert.ok(error instanceof ContainerError, `${error.stack}`);
    assert.match(error.message, pattern);
    return true;
  });

describe('decoder', () => {
  const golden = (name) => readFileSync(new URL(`../../golden/${name}`, import.meta.url));
  test('gives back every layer and texel', async () => {
    const got = await decode(bytes, decodePicture);
    assert.equal(got.layers.count, scene.layers.length);
    let texel = 0;
    let hidden = 0;
    scene.layers.forEach((layer, i) => {
      assert.deepEqual([got.layers.x[i], got.layers.y[i], got.layers.w[i], got.layers.h[i]], [layer.x, layer.y, layer.w, layer.h]);
      assert.equal(got.layers.a[i], layer.plane.a);
      assert.equal(got.layers.firstTexel[i], texel);
      assert.equal(got.layers.firstHidden[i], hidden);
      layer.classes.forEach((kind, k) => {
        assert.equal(got.classes[texel], kind);
        assert.equal(got.alpha[texel], layer.alpha[k]);
        if (kind === Class.HIDDEN) {
          const colour = wall(layer.x + (k % layer.w), layer.y + Math.floor(k / layer.w)).map(Math.round);
          assert.deepEqual([...got.hidden.subarray(hidden * 3, hidden * 3 + 3)], colour);
          hidden++;
        }
        texel++;
      });
    });
    assert.ok(hidden > 200, 'the scene has hidden texels');
    assert.equal(got.hidden.length, hidden * 3);
  });

  test('comes to the same texels as the server, bit for bit', async () => {
    const want = JSON.parse(golden('v1.json'));
    const picture = async () => ({ width: 4096, height: 4096, data: new Uint8Array(4096 * 4096 * 4) });
    const got = await decode(new Uint8Array(golden('v1.tmpi')), picture, { width: want.width, height: want.height });
    const hash = (data) => createHash('sha256').update(data).digest('hex');
    const layers = Array.from({ length: got.layers.count }, (_, i) => ['a', 'b', 'c', 'x', 'y', 'w', 'h'].map((key) => got.layers[key][i]));
    assert.deepEqual(layers, want.layers);
    assert.deepEqual([hash(got.classes), hash(got.alpha), got.hidden.length / 3], [want.classes, want.alpha, want.hidden]);
  });

  // from the second on with labels in two bands
  for (const [name, labelJobs] of [
    ['v1_1', 0],
    ['v1_2', 2],
    ['v1_3', 2],
  ]) {
    test(`fills hidden texels that are not carried as the server does, bit for bit: ${name}`, async () => {
      const want = JSON.parse(golden(`${name}.json`));
      const { width, height } = want;
      // the photo of that container, which is a file without loss
      const data = new Uint8Array(width * height * 4);
      for (let i = 0; i < width * height; i++) {
        data.set([Math.floor(((i % width) * 255) / width), Math.floor((Math.floor(i / width) * 255) / height), 90, 255], i * 4);
      }
      const none = async () => assert.fail('there is no other picture');
      const got = await decode(new Uint8Array(golden(`${name}.tmpi`)), none, { width, height, data });
      // the same in bands that are handed over, as to other threads
      for (const count of [2, 3, 100]) {
        let handed = 0;
        const elsewhere = async (band) => {
          const { band: copy, buffers } = detached(band);
          handed++;
          return work(structuredClone({ copy }, { transfer: buffers }).copy);
        };
        const parts = await decode(new Uint8Array(golden(`${name}.tmpi`)), none, { width, height, data }, elsewhere, count);
        assert.deepEqual({ ...parts, photo: null }, { ...got, photo: null });
        assert.equal(handed, Math.min(count, tileCounts(parts).tiles) + Math.min(count, labelJobs));
      }
      const hash = (bytes) => createHash('sha256').update(bytes).digest('hex');
      assert.deepEqual([hash(got.classes), hash(got.alpha)], [want.classes, want.alpha]);
      assert.deepEqual([got.hidden.length / 3, hash(got.hidden)], [want.hidden, want.colours]);
      const { layers, classes } = got;
      const before = (i) => classes.subarray(0, layers.firstTexel[i]).reduce((n, kind) => n + (kind === Class.HIDDEN), 0);
      for (let i = 0; i < layers.count; i += 5) assert.equal(layers.firstHidden[i], before(i));
    });
  }

  test('a damaged band of labels is told by its number, bands that do not fit are refused', async () => {
    const file = new Uint8Array(golden('v1_2.tmpi'));
    const { index, start } = readIndex(file);
    const section = index.sections.find((s) => s.kind === Kind.LABELS);
    assert.equal(section.bands.length, 2);
    const photo = { width: index.width, height: index.height, data: new Uint8Array(index.width * index.height * 4) };
    const refused = (data, pattern) =>
      assert.rejects(decode(data, null, photo), (e) => e instanceof ContainerError && pattern.test(e.message));
    for (const [at, number] of [
      [0, 1],
      [section.bands[0].length, 2],
    ]) {
      const damaged = file.slice();
      damaged[start + section.offset + at] ^= 4;
      await refused(damaged, new RegExp(`band ${number} of 2 of the labels is damaged`));
    }
    await refused(file.subarray(0, start + section.offset + section.bands[0].length), /ends after the last byte/);
    // a message of a band is `rows`, `length`, `check`: rows of the first one more
    const head = [0x32, 0, 0x08, 1, 0x10];
    const at = file.findIndex((_, i) => head.every((byte, k) => k === 1 || file[i + k] === byte));
    const more = file.slice();
    more[at + 3] = 2;
    await refused(more, /other rows of tiles/);
    assert.equal(crc32(new TextEncoder().encode('123456789')), 0xcbf4_3926);
  });

  test('needs only the first bytes for index and photo', () => {
    for (let n = 0; n < 12; n++) assert.equal(readIndex(bytes.subarray(0, n)), null);
    const head = readIndex(bytes.subarray(0, 12 + new DataView(bytes.buffer).getUint32(8, true)));
    assert.equal(head.index.width, scene.width);
    assert.ok(endOfSection(head, Kind.PHOTO) < bytes.length);
  });

  test('refuses a newer major version and says which', async () => {
    await refuses(new Uint8Array(container(scene, { major: 2 })), /version 2; this program reads up to version 1/);
  });

  test('names what is wrong', async () => {
    await refuses(Uint8Array.from([1, 2, 3, 4, 5]), /does not start with "TMPI"/);
    await refuses(
      altered((index) => (index[0] = 0)),
      /photo of 0 × 120/,
    );
    await refuses(
      altered((index) => (index[0] = 20_000)),
      /photo of 20000/,
    );
    await refuses(
      altered((index) => (index[4] = NaN)),
      /fx is not a number/,
    );
    await refuses(
      altered((index) => (index[3] = 65)),
      /tiles of 64 pixels every 65/,
    );
    await refuses(
      altered((index) => (index[11] += 1)),
      /planes section has/,
    );
    await refuses(
      altered((index) => (index[11] = 1e7)),
      /10000000 planes/,
    );
    await refuses(
      altered((index) => (index[13] -= 1)),
      /hidden cells/,
    );
    await refuses(
      altered((index) => (index[14] = 9)),
      /do not fit a hidden picture/,
    );
    await refuses(
      altered((_, sections) => sections.splice(0, 1)),
      /no photo section/,
    );
    await refuses(
      altered((_, sections) => (sections[1].bytes[9 + 3] = 0)),
      /planes in the tiles|1 to 64 planes/,
    );
    await refuses(
      altered((_, sections) => (sections[1].bytes[5] ^= 1)),
      /planes section unpacks to/,
    );
    await refuses(
      altered((_, sections) => sections.splice(2, 1)),
      /no labels section/,
    );
    await refuses(
      altered((_, sections) => (sections[1].codec = 'png')),
      /planes section has codec 3/,
    );
  });

  test('no cut and no flipped byte brings it down', async () => {
    for (let n = 0; n < bytes.length; n += 97) {
      await assert.rejects(decode(bytes.slice(0, n), decodePicture), ContainerError);
    }
    // a generator with a fixed seed, so that a failure can be run again
    let seed = 1;
    const random = (n) => {
      seed = (seed * 48271) % 2147483647;
      return seed % n;
    };
    const start = readIndex(bytes).start;
    const outcomes = { fine: 0, refused: 0 };
    for (let i = 0; i < 400; i++) {
      const damaged = bytes.slice();
      damaged[random(start)] ^= 1 << random(8);
      try {
        await decode(damaged, decodePicture);
        outcomes.fine++;
      } catch (error) {
        assert.ok(error instanceof ContainerError, `${error.stack}`);
        outcomes.refused++;
      }
    }
    assert.ok(outcomes.refused > 100, JSON.stringify(outcomes));
  });
});

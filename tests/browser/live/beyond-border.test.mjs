// A room continues beyond its borders: mirrored instances look the same as mirrored copies of the texels.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { describe, test } from 'node:test';
import { fractionDifferent, openPage } from '../support/browser.mjs';
import { boxSuite } from '../support/suite.mjs';

const seed = (name) => readFileSync(new URL(`../../../fuzz/seeds/message/${name}`, import.meta.url)).toString('base64');
const SEEDS = ['hello', 'geometry', 'snapshot'].map(seed);
/** The room's size, and views from the side that see beyond the borders. */
const [WIDTH, HEIGHT] = [130, 100];
const POSES = [
  { tx: 0, ty: 0, tz: 0, yaw: 0, pitch: 0, roll: 0 },
  { tx: 0.03, ty: 0.02, tz: -0.02, yaw: 0, pitch: 0, roll: 0 },
  { tx: -0.03, ty: -0.03, tz: 0.01, yaw: 0, pitch: 0, roll: 0 },
];

/** In the page: draws views of the room with mirrored instances, then with mirrored copies. */
async function drawViews({ seeds, poses, webgpu, width, height }) {
  const { compiled, PIXELS, RoomDecoder } = await import('/static/live/decoder.js');
  const { TileAtlas } = await import('/static/live/tile-atlas.js');
  const { pieces: piecesOf } = await import('/static/draw/border.js');
  const { instances } = await import('/static/draw/instances.js');
  const decoder = await RoomDecoder.of(await compiled());
  const messages = seeds.map((text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)));
  const { head } = decoder.read(messages[0]);
  const colour = (i, c) => (c === 3 ? 255 : (Math.floor(i / 7) * 37 + c * 80 + Math.floor(i / width) * 5) % 256);
  decoder.frame(
    PIXELS.RGBA,
    Uint8Array.from({ length: head.width * head.height * 4 }, (_, i) => colour(i >> 2, i & 3)),
  );
  for (const message of messages.slice(1)) decoder.read(message);
  const changed = decoder.layers();
  const atlas = new TileAtlas(head, 2048);
  const { numbers, places } = atlas.change(changed);
  const cells = { places, data: decoder.cells(numbers) };
  const one = atlas.drawn();
  const scene = { ...head, ...one, atlas: { ...atlas.size, pages: atlas.pages, wide: false, strips: [] }, decodeMs: 0 };

  // copy each piece to its own square of a page
  const texels = new Map();
  let offset = 0;
  let layer = 0;
  const first = new Map();
  for (const { tile, layers } of changed) {
    first.set(tile, layer);
    layer += layers.length;
  }
  for (let i = 0; i < numbers.length; i += 2) {
    const [w, h] = places.subarray((i / 2) * 5 + 3, (i / 2) * 5 + 5);
    texels.set(first.get(numbers[i]) + numbers[i + 1], { w, data: cells.data.subarray(offset, offset + w * h * 4) });
    offset += w * h * 4;
  }
  const pieces = piecesOf({ ...head, layers: one.layers });
  const across = 16;
  const side = across * head.tileSize;
  const at = pieces.map((_, i) => [(i % across) * head.tileSize, Math.floor(i / across) * head.tileSize]);
  const copies = { places: [], data: [] };
  pieces.forEach(({ layer: index, u, v, w, h, flipX, flipY }, i) => {
    const { w: row, data } = texels.get(index);
    copies.places.push(0, ...at[i], w, h);
    for (let y = 0; y < h; y++) {
      for (let x = 0; x < w; x++) {
        const from = ((v + (flipY ? h - 1 - y : y)) * row + u + (flipX ? w - 1 - x : x)) * 4;
        copies.data.push(...data.subarray(from, from + 4));
      }
    }
  });
  const where = { page: pieces.map(() => 0), atlasX: at.map(([x]) => x), atlasY: at.map(([, y]) => y) };
  const other = { ...scene, instances: instances({ ...head, layers: one.layers }, pieces, where) };
  other.atlas = { width: side, height: side, pages: 1, wide: false, strips: [] };
  const views = [];
  for (const [input, filled] of [
    [scene, cells],
    [other, { places: Uint32Array.from(copies.places), data: Uint8Array.from(copies.data) }],
  ]) {
    const renderer = webgpu
      ? await (await import('/static/draw/webgpu.js')).WebGpuRenderer.create(input, () => {})
      : await (await import('/static/draw/webgl.js')).WebGlRenderer.create(document.createElement('canvas'), input, () => {});
    renderer.update({ instances: null, cells: filled });
    for (const pose of poses) {
      const data = await renderer.readPixels(pose, head.intrinsics, width, height);
      views.push(btoa(String.fromCharCode(...data)));
    }
    renderer.dispose();
  }
  return { views, mirrored: pieces.filter(({ flipX, flipY }) => flipX || flipY).length, size: [head.width, head.height] };
}

for (const [name, webgpu] of [
  ['WebGPU', true],
  ['WebGL', false],
]) {
  describe(`a room beyond its borders, ${name}`, () => {
    const suite = boxSuite({ webgpu });

    test('looks like mirrored copies of its texels', async () => {
      const { page, context } = await openPage(suite.browser);
      await page.goto(`${suite.server.url}/view/box`);
      const given = { seeds: SEEDS, poses: POSES, webgpu, width: WIDTH, height: HEIGHT };
      const { views, mirrored, size } = await page.evaluate(drawViews, given);
      assert.ok(mirrored > 0);
      assert.deepEqual(size, [WIDTH, HEIGHT]);
      const pixels = views.map((text) => new Uint8ClampedArray(Buffer.from(text, 'base64')));
      POSES.forEach((_, i) => {
        const [actual, expected] = [pixels[i], pixels[i + POSES.length]];
        assert.equal(fractionDifferent(actual, expected, WIDTH, HEIGHT, { levels: 2 }), 0, `view ${i}`);
        const empty = actual.filter((v, k) => k % 4 === 3 && v < 255).length;
        assert.ok(empty < 0.02 * WIDTH * HEIGHT, `view ${i}: ${empty} pixels are not covered`);
      });
      // the second view sees beyond the border
      assert.ok(fractionDifferent(pixels[0], pixels[1], WIDTH, HEIGHT) > 0.3);
      await context.close();
    });
  });
}

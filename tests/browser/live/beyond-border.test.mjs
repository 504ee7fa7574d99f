// A room continues beyond its borders with the colours at them, blurred more with the distance, and not as a mirror image.
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

/** The largest difference, in levels, of pixels that count as the same. */
const SAME = 8;

/**
 * In the page: draws views of the room, then of the same room with mirror images beyond its borders: first a wide one from the home position,
 * where each pixel beyond a border is opposite to its mirror image, then one from each pose, then their depths.
 */
async function drawViews({ seeds, poses, webgpu, width, height }) {
  const { compiled, PIXELS, RoomDecoder } = await import('/static/live/decoder.js');
  const { TileAtlas } = await import('/static/live/tile-atlas.js');
  const { pieces: piecesOf } = await import('/static/draw/border.js');
  const { instances } = await import('/static/draw/instances.js');
  const { margins } = await import('/static/view/camera-limits.js');
  const decoder = await RoomDecoder.of(await compiled());
  const messages = seeds.map((text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)));
  const { head } = decoder.read(messages[0]);
  // fine stripes over slopes by which each border has colours of its own
  const slope = (x, y, c) => 75 * [2 * x, 2 * y, x + 1 - y][c];
  const stripes = (i, c) => ((Math.floor(i / 7) * 37 + c * 80 + Math.floor(i / width) * 5) % 256) * 0.4;
  const colour = (i, c) => (c === 3 ? 255 : slope((i % width) / width, Math.floor(i / width) / height, c) + stripes(i, c));
  for (const message of messages.slice(1)) decoder.read(message);
  decoder.frame(
    PIXELS.RGBA,
    Uint8Array.from({ length: head.width * head.height * 4 }, (_, i) => colour(i >> 2, i & 3)),
  );
  const changed = decoder.layers();
  const atlas = new TileAtlas(head, 2048);
  const { numbers, places } = atlas.change(changed);
  const cells = { places, data: decoder.cells(numbers, atlas.borderColumns) };
  const one = atlas.drawn();
  const scene = { ...head, ...one, atlas: { ...atlas.size, pages: atlas.pages, wide: false, strips: [] }, decodeMs: 0 };

  // the fault: a copy of each piece, mirrored beyond the borders, in its own square of a page
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
  const margin = margins(head);
  const { fx, fy, cx, cy } = head.intrinsics;
  const wide = { fx, fy, cx: cx + margin.x, cy: cy + margin.y };
  const views = [];
  for (const [input, filled] of [
    [scene, cells],
    [other, { places: Uint32Array.from(copies.places), data: Uint8Array.from(copies.data) }],
  ]) {
    const renderer = webgpu
      ? await (await import('/static/draw/webgpu.js')).WebGpuRenderer.create(input, () => {})
      : await (await import('/static/draw/webgl.js')).WebGlRenderer.create(document.createElement('canvas'), input, () => {});
    renderer.update({ instances: null, cells: filled });
    const text = (data) => btoa(data.reduce((all, byte) => all + String.fromCharCode(byte), ''));
    views.push(text(await renderer.readPixels(poses[0], wide, width + 2 * margin.x, height + 2 * margin.y)));
    for (const overlay of [0, 1]) {
      renderer.overlay = overlay;
      for (const pose of poses) views.push(text(await renderer.readPixels(pose, head.intrinsics, width, height)));
    }
    renderer.dispose();
  }
  const mirrored = pieces.filter(({ flipX, flipY }) => flipX || flipY).length;
  return { views, margin: [margin.x, margin.y], mirrored, size: [head.width, head.height] };
}

/**
 * What a wide view shows beyond the borders: the share of pixels that look like their mirror images, and the mean difference, in levels, of
 * neighbours along the outermost lines.
 * @param {Uint8ClampedArray} pixels
 * @param {number[]} margin
 */
function beyond(pixels, [marginX, marginY]) {
  const [across, down] = [WIDTH + 2 * marginX, HEIGHT + 2 * marginY];
  const at = (x, y, c) => pixels[(y * across + x) * 4 + c];
  const mirror = (v, margin, size) => (v < margin ? 2 * margin - 1 - v : v < margin + size ? v : 2 * (margin + size) - 1 - v);
  let [alike, all] = [0, 0];
  let [steps, lines] = [0, 0];
  for (let y = 0; y < down; y++) {
    for (let x = 0; x < across; x++) {
      const [mx, my] = [mirror(x, marginX, WIDTH), mirror(y, marginY, HEIGHT)];
      if (mx === x && my === y) continue;
      all++;
      if ([0, 1, 2].every((c) => Math.abs(at(x, y, c) - at(mx, my, c)) <= SAME)) alike++;
      // the corners are smooth in either case
      const next = [0, across - 1].includes(x) && my === y ? [x, y + 1] : [0, down - 1].includes(y) && mx === x ? [x + 1, y] : null;
      if (!next) continue;
      lines++;
      steps += [0, 1, 2].reduce((sum, c) => sum + Math.abs(at(x, y, c) - at(...next, c)) / 3, 0);
    }
  }
  return { alike: alike / all, steps: steps / lines };
}

/**
 * Mean difference, in levels, between pixels just beyond each border and the mean of the 3 × 3 pixels at the nearest place within it, and of
 * those at the opposite border.
 * @param {Uint8ClampedArray} pixels
 * @param {number[]} margin
 */
function continuation(pixels, margin) {
  const sizes = [WIDTH, HEIGHT];
  const across = WIDTH + 2 * margin[0];
  const at = ([x, y], c) => pixels[((y + margin[1]) * across + x + margin[0]) * 4 + c];
  const around = ([x, y], c) => [-1, 0, 1].flatMap((dy) => [-1, 0, 1].map((dx) => at([x + dx, y + dy], c))).reduce((a, b) => a + b) / 9;
  const places = [0, 1].flatMap((axis) =>
    [-3, sizes[axis] + 2].flatMap((beyond) =>
      Array.from({ length: sizes[1 - axis] - 16 }, (_, i) => {
        const place = (v) => (axis ? [i + 8, v] : [v, i + 8]);
        const ends = [place(1), place(sizes[axis] - 2)];
        const [near, opposite] = beyond < 0 ? ends : ends.toReversed();
        return { beyond: place(beyond), near, opposite };
      }),
    ),
  );
  const mean = (end) => {
    const off = places.flatMap((p) => [0, 1, 2].map((c) => Math.abs(at(p.beyond, c) - around(p[end], c))));
    return off.reduce((a, b) => a + b) / off.length;
  };
  return { near: mean('near'), opposite: mean('opposite') };
}

for (const [name, webgpu] of [
  ['WebGPU', true],
  ['WebGL', false],
]) {
  describe(`a room beyond its borders, ${name}`, () => {
    const suite = boxSuite({ webgpu });

    test('continues the colours at them and shows no mirror image', async () => {
      const { page, context } = await openPage(suite.browser);
      await page.goto(`${suite.server.url}/view/box`);
      const given = { seeds: SEEDS, poses: POSES, webgpu, width: WIDTH, height: HEIGHT };
      const { views, margin, mirrored, size } = await page.evaluate(drawViews, given);
      assert.ok(mirrored > 0 && margin.every((v) => v >= 10), `${mirrored} pieces, ${margin} pixels`);
      assert.deepEqual(size, [WIDTH, HEIGHT]);
      const pixels = views.map((text) => new Uint8ClampedArray(Buffer.from(text, 'base64')));
      const count = 1 + 2 * POSES.length;
      const [room, faulty] = [pixels.slice(0, count), pixels.slice(count)];
      const [shown, mirrors] = [beyond(room[0], margin), beyond(faulty[0], margin)];
      assert.ok(mirrors.alike > 0.9 && mirrors.steps > 12, `mirror images are found: ${JSON.stringify(mirrors)}`);
      assert.ok(shown.alike < 0.2 && shown.steps < mirrors.steps / 4, JSON.stringify({ shown, mirrors }));
      const { near, opposite } = continuation(room[0], margin);
      assert.ok(near < opposite / 4, `${near} levels from the nearest border, ${opposite} from the opposite one`);
      // within the borders, both are the same
      const [across, down] = [WIDTH + 2 * margin[0], HEIGHT + 2 * margin[1]];
      const [x0, y0] = [margin[0] / across, margin[1] / down];
      // half a pixel for rounding
      const [halfX, halfY] = [0.5 / across, 0.5 / down];
      const within = { levels: 2, x0: x0 + halfX, y0: y0 + halfY, x1: 1 - x0 - halfX, y1: 1 - y0 - halfY };
      assert.equal(fractionDifferent(room[0], faulty[0], across, down, within), 0);
      assert.equal(fractionDifferent(room[1], faulty[1], WIDTH, HEIGHT, { levels: 2 }), 0);
      // and so is the shape anywhere
      for (let i = 1 + POSES.length; i < count; i++) {
        assert.equal(fractionDifferent(room[i], faulty[i], WIDTH, HEIGHT, { levels: 2 }), 0, `depths of view ${i}`);
      }
      for (const view of room) {
        const empty = view.filter((v, k) => k % 4 === 3 && v < 255).length;
        assert.ok(empty < (0.02 * view.length) / 4, `${empty} pixels are not covered`);
      }
      // the second pose sees beyond the border
      assert.ok(fractionDifferent(room[1], room[2], WIDTH, HEIGHT) > 0.3);
      await context.close();
    });
  });
}

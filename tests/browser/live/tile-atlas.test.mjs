// Places for changing layers in the atlas.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { TileAtlas } from '../../../static/live/tile-atlas.js';

const HEAD = {
  width: 176,
  height: 120,
  tileSize: 64,
  tileStride: 56,
  intrinsics: { fx: 116, fy: 116, cx: 88, cy: 60 },
  viewBox: { x: 0.03, y: 0.03, z: 0.03 },
};
const [COLUMNS, TILES] = [3, 6];
/** Numbers of a place, and the last place: that of the border's means. */
const PLACE = 5;
const last = (places) => [...places.subarray(-PLACE)];

/** Layers that fill a tile. */
function filling(tile, count) {
  const [x, y] = [(tile % COLUMNS) * 56, Math.floor(tile / COLUMNS) * 56];
  const [w, h] = [Math.min(64, HEAD.width - x), Math.min(64, HEAD.height - y)];
  return Array.from({ length: count }, (_, i) => Float64Array.of(0.2 + 0.1 * i, 0, 0, x, y, w, h, w * h, i ? 1 : 0));
}

const all = (count) => Array.from({ length: TILES }, (_, tile) => ({ tile, layers: filling(tile, count) }));

/** Used squares and their layers; throws if two layers share a square, or one is outside the pages. */
function squares(atlas) {
  const { instances } = atlas.drawn();
  const { width, height } = atlas.size;
  const seen = new Map();
  for (let i = 0; i < instances.opaque; i++) {
    const [a, , , page, , , , , w, h, x, y] = instances.data.subarray(i * 12, i * 12 + 12);
    // mirrored instances start at the opposite side
    const [left, upper] = [x < 0 ? -x - w : x, y < 0 ? -y - h : y];
    const at = [page, Math.floor(left / 64), Math.floor(upper / 64)].join();
    assert.equal(at, [page, Math.ceil((left + w) / 64) - 1, Math.ceil((upper + h) / 64) - 1].join(), 'the layer is within a square');
    const layer = [instances.tiles[i], a].join();
    assert.equal(seen.get(at) ?? layer, layer, `two layers at ${at}`);
    assert.ok(page < atlas.pages && left + w <= width && upper + h <= height - 28, at);
    seen.set(at, layer);
  }
  return seen;
}

describe('tile atlas', () => {
  test('no two layers share a square', () => {
    const atlas = new TileAtlas(HEAD, 2048);
    const first = atlas.change(all(2));
    assert.ok(first.reshaped && !first.grown);
    const layers = first.numbers.length / 2;
    assert.equal(layers + 1, first.places.length / PLACE);
    assert.equal(squares(atlas).size, layers);
    for (let n = 0; n < 40; n++) {
      const tile = (n * 5) % TILES;
      const change = atlas.change([{ tile, layers: filling(tile, 1 + (n % 4)) }]);
      const filled = [...change.numbers].filter((_, i) => i % 2 === 0);
      assert.ok(change.grown || filled.every((t) => t === tile), 'only squares of the changed tile');
      squares(atlas);
    }
  });

  test('instances beyond the border mirror the same texels', () => {
    const atlas = new TileAtlas(HEAD, 2048);
    const { numbers } = atlas.change(all(1));
    assert.equal(numbers.length / 2, TILES);
    const { instances } = atlas.drawn();
    const rows = Array.from({ length: instances.opaque }, (_, i) => [...instances.data.subarray(i * 12, i * 12 + 12)]);
    // tile 0: itself, mirrored left, mirrored above, and both
    const [plain, left, above, both] = rows.filter((_, i) => instances.tiles[i] === 0);
    assert.ok(plain[10] >= 0 && plain[11] >= 0);
    // the column at the border is the same on both sides, and so is the row
    assert.deepEqual([left[6] + left[8], -left[10] - left[8]], [plain[6], plain[10]]);
    assert.deepEqual([above[7] + above[9], -above[11] - above[9]], [plain[7], plain[11]]);
    assert.deepEqual([left[11], above[10], both[10], both[11]], [plain[11], plain[10], left[10], above[11]]);
  });

  test('a tile with unchanged layers keeps its squares', () => {
    const atlas = new TileAtlas(HEAD, 2048);
    const { places } = atlas.change(all(2));
    const again = atlas.change([{ tile: 0, layers: null }]);
    assert.ok(!again.reshaped && again.places.length > 0);
    assert.deepEqual([...again.places.subarray(0, -PLACE)], [...places.subarray(0, again.places.length - PLACE)]);
    assert.deepEqual(last(again.places), last(places));
  });

  test('the border’s means have a place below the squares, as wide as the longest border or as the page', () => {
    for (const [size, most, columns] of [
      [{}, 2048, 177],
      [{ width: 120, height: 170 }, 2048, 171],
      [{ width: 4096, height: 40 }, 2048, 2048],
      [{ width: 1920, height: 1088 }, 2048, 1921],
    ]) {
      const atlas = new TileAtlas({ ...HEAD, ...size }, most);
      const { width, height } = atlas.size;
      assert.ok(width <= most && height <= most, `${width}×${height}`);
      assert.equal(atlas.borderColumns, Math.min(columns, width));
      assert.equal(height % HEAD.tileSize, 28);
      assert.deepEqual(last(atlas.change([]).places), [0, 0, height - 28, atlas.borderColumns, 28]);
    }
  });

  test('a full atlas moves to larger pages', () => {
    const atlas = new TileAtlas(HEAD, 2048);
    atlas.change(all(1));
    const before = atlas.size.width * atlas.size.height * atlas.pages;
    const change = atlas.change(all(48));
    assert.ok(change.grown && atlas.size.width * atlas.size.height * atlas.pages > before);
    assert.equal(squares(atlas).size, change.places.length / PLACE - 1);
    assert.deepEqual(atlas.all().places, change.places);
  });
});

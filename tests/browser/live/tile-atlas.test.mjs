// Places of layers that come and go.
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

/** Layers that fill a tile. */
function layers(tile, count) {
  const [x, y] = [(tile % COLUMNS) * 56, Math.floor(tile / COLUMNS) * 56];
  const [w, h] = [Math.min(64, HEAD.width - x), Math.min(64, HEAD.height - y)];
  return Array.from({ length: count }, (_, i) => Float64Array.of(0.2 + 0.1 * i, 0, 0, x, y, w, h, w * h, i ? 1 : 0));
}

const all = (count) => Array.from({ length: TILES }, (_, tile) => ({ tile, layers: layers(tile, count) }));

/** Squares in use, as text; throws where two instances share one or one lies beyond the pages. */
function squares(atlas) {
  const { instances } = atlas.drawn();
  const { width, height } = atlas.size;
  const seen = new Set();
  for (let i = 0; i < instances.opaque; i++) {
    const [page, x, y] = [3, 10, 11].map((k) => instances.data[i * 12 + k]);
    const at = [page, Math.floor(x / 64), Math.floor(y / 64)].join();
    assert.ok(!seen.has(at), `two pieces at ${at}`);
    assert.ok(page < atlas.pages && x < width && y < height, at);
    seen.add(at);
  }
  return seen;
}

describe('places of tiles', () => {
  test('no two pieces share a square, whatever comes and goes', () => {
    const atlas = new TileAtlas(HEAD, 2048);
    const first = atlas.change(all(2));
    assert.ok(first.reshaped && !first.grown);
    assert.equal(first.numbers.length / 8, first.places.length / 5);
    assert.equal(squares(atlas).size, first.places.length / 5);
    for (let n = 0; n < 40; n++) {
      const tile = (n * 5) % TILES;
      const change = atlas.change([{ tile, layers: layers(tile, 1 + (n % 4)) }]);
      const filled = [...change.numbers].filter((_, i) => i % 8 === 0);
      assert.ok(change.grown || filled.every((t) => t === tile), 'of that tile alone');
      squares(atlas);
    }
  });

  test('a tile that has the layers of before keeps its squares', () => {
    const atlas = new TileAtlas(HEAD, 2048);
    const { places } = atlas.change(all(2));
    const again = atlas.change([{ tile: 0, layers: null }]);
    assert.ok(!again.reshaped && again.places.length > 0);
    assert.deepEqual([...again.places], [...places.subarray(0, again.places.length)]);
  });

  test('where there is no place left all are filled anew on larger pages', () => {
    const atlas = new TileAtlas(HEAD, 2048);
    atlas.change(all(1));
    const before = atlas.size.width * atlas.size.height * atlas.pages;
    const change = atlas.change(all(48));
    assert.ok(change.grown && atlas.size.width * atlas.size.height * atlas.pages > before);
    assert.equal(squares(atlas).size, change.places.length / 5);
    assert.deepEqual(atlas.all().places, change.places);
  });
});

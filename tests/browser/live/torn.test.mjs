import assert from 'node:assert/strict';
import { test } from 'node:test';
import { tornRows } from '../support/torn.mjs';
import { HEIGHT, rgba, WIDTH } from '../support/video.mjs';

/** A frame of the film in which some rows are moved. */
function moved(by) {
  const frame = rgba(0);
  const out = new Uint8ClampedArray(frame.length);
  for (let y = 0; y < HEIGHT; y++)
    for (let x = 0; x < WIDTH; x++) {
      const from = (y * WIDTH + Math.min(Math.max(x - by(y), 0), WIDTH - 1)) * 4;
      out.set(frame.subarray(from, from + 4), (y * WIDTH + x) * 4);
    }
  return out;
}

test('a box that is whole, moved or slanted is not torn', () => {
  for (const by of [() => 0, () => 9, (y) => Math.round(y / 12)]) assert.equal(tornRows(moved(by), WIDTH, HEIGHT), 0);
});

test('rows that a tile moved by five pixels are torn, and so is a picture without the box', () => {
  const share = tornRows(
    moved((y) => (y >= 112 && y < 126 ? 5 : 0)),
    WIDTH,
    HEIGHT,
  );
  assert.ok(Math.abs(share - 14 / 134) < 0.01, `${share}`);
  assert.equal(tornRows(new Uint8ClampedArray(WIDTH * HEIGHT * 4), WIDTH, HEIGHT), 1);
});

test('a speck that stays behind tears its row', () => {
  const picture = moved(() => 0);
  picture.set([250, 150, 100, 255], (150 * WIDTH + 250) * 4);
  const share = tornRows(picture, WIDTH, HEIGHT);
  assert.ok(share > 0 && share < 0.01, `${share}`);
});

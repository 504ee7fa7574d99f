// How many rows around its tiles a band of a container needs: the rule of `farthest` in crates/core/src/layers/reach.rs.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';
import { readHead } from '../../../static/decode/head.js';

/** A container of 150 × 100 pixels with a focal length of 300, and this view box. */
function container({ y, z }) {
  const bytes = readFileSync(new URL('../../golden/v1_bands.tmpi', import.meta.url));
  const end = 12 + bytes.readUInt32LE(8);
  const extents = Buffer.alloc(18);
  extents.writeUInt8((10 << 3) | 1, 0);
  extents.writeDoubleLE(y, 1);
  extents.writeUInt8((11 << 3) | 1, 9);
  extents.writeDoubleLE(z, 10);
  // of a repeated field, the last counts
  const index = Buffer.concat([bytes.subarray(12, end), extents]);
  const head = Buffer.from(bytes.subarray(0, 12));
  head.writeUInt32LE(index.length, 8);
  return new Uint8Array(Buffer.concat([head, index, bytes.subarray(end)]));
}

test('a band needs as many rows as cameras look past an edge', () => {
  const reach = (y, z) => readHead(container({ y, z })).reach;
  assert.deepEqual([reach(0, 0), reach(0.03, 0.03), reach(1, 0.03), reach(0.5, 5), reach(10, 0)], [96, 96, 303, 202, 1664]);
});

// Labels as the range coder has them.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { tileCounts, tileRect } from '../../../static/decode/grid.js';
import { decodeLabels } from '../../../static/decode/labels.js';
import { ContainerError } from '../../../static/decode/protobuf.js';

describe('labels', () => {
  const grid = { width: 149, height: 33, tileSize: 17, tileStride: 15 };
  const { columns, tiles } = tileCounts(grid);
  // up to five labels a tile in stripes, as the server's encoder wrote them
  const counts = Uint8Array.from({ length: tiles }, (_, t) => 1 + ((t * 7 + 9) % 5));
  const written =
    '4EENx6K2a7AxP85OcNniGoZ8yLA7G2l4pCBsRLV26/go6M6RIqDuePSTjKmZ0Mqxxs+/AmNLptaqMQlzCIp0o8YkS3BmhytOWhVEnChA/uBGgHIspBDrIAByjxRP0ABnlS753eBOElBjRdqsLXkJvuwTjBosGEPB4iSIVjsHbRG5xhxTD0+SIxtt6/yZ1gnwug==';
  const data = new Uint8Array(Buffer.from(written, 'base64'));

  test('what the server wrote is read', () => {
    const want = [];
    for (let t = 0; t < tiles; t++) {
      const r = tileRect(grid, columns, t);
      for (let y = 0; y < r.h; y++) {
        for (let x = 0; x < r.w; x++) {
          const stripe = Math.floor((x + r.x) / 9) + Math.floor((y + r.y) / 13) + Math.floor((x * y) / 400);
          want.push(stripe % counts[t]);
        }
      }
    }
    assert.deepEqual([...decodeLabels(grid, counts, data)], want);
  });

  test('damage gives valid labels, a wrong count an error', () => {
    for (const damaged of [data.subarray(0, 20), data.map((b, i) => (i % 7 ? b : ~b)), new Uint8Array(0)]) {
      const labels = decodeLabels(grid, counts, damaged);
      let at = 0;
      for (let t = 0; t < tiles; t++) {
        const { w, h } = tileRect(grid, columns, t);
        assert.ok(labels.subarray(at, at + w * h).every((label) => label < counts[t]));
        at += w * h;
      }
    }
    assert.throws(() => decodeLabels(grid, counts.slice(1), data), ContainerError);
    assert.throws(() => decodeLabels(grid, counts.fill(65, 0, 1), data), ContainerError);
  });
});

// Compares the WebAssembly decoder bit for bit with tests/golden/digests.txt; crates/decoder/tests/golden.rs checks the native decoder against it.
import assert from 'node:assert/strict';
import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { describe, test } from 'node:test';
import { readHead } from '../../../static/decode/head.js';
import { decodeTexels, sceneDigest } from '../support/decoder.mjs';

const GOLDEN = new URL('../../golden/', import.meta.url);
const VARIANTS = 200;
const MOST_PIXELS = 200_000;

/** A picture that needs no codec. */
function pattern(width, height) {
  const data = new Uint8Array(width * height * 4);
  for (let y = 0, i = 0; y < height; y++) {
    for (let x = 0; x < width; x++, i += 4) data.set([x * 7 + y * 3, (x * 5) ^ (y * 11), x * y + 13, 255], i);
  }
  return { width, height, data };
}

/** Digest of a container decoded with the pattern as its pictures, or `refused`. */
async function outcome(bytes) {
  try {
    const head = readHead(bytes);
    if (!head) return 'refused';
    const { width, height } = head.scene;
    if (width * height > MOST_PIXELS) return 'refused';
    const hidden = head.hidden && pattern(...hiddenSize(bytes));
    return sceneDigest(head.scene, await decodeTexels(bytes, { photo: pattern(width, height), hidden }));
  } catch (error) {
    assert.ok(!/^the decoder failed/.test(error.message), error.message);
    return 'refused';
  }
}

/** Size of the hidden picture from the index's fields 14 and 15: number of 8-pixel blocks, and blocks per row. */
function hiddenSize(bytes) {
  const fields = new Map();
  let at = 12;
  const varint = () => {
    let value = 0n;
    for (let shift = 0n; ; shift += 7n) {
      value |= BigInt(bytes[at] & 127) << shift;
      if (bytes[at++] < 128) return value;
    }
  };
  const end = 12 + new DataView(bytes.buffer, bytes.byteOffset).getUint32(8, true);
  while (at < end) {
    const key = Number(varint());
    if (key % 8 === 0) fields.set(key >> 3, Number(BigInt.asUintN(32, varint())));
    else {
      // `at +=` would read `at` before `varint` moves it
      const length = key % 8 === 1 ? 8 : key % 8 === 5 ? 4 : Number(varint());
      at += length;
    }
  }
  const [blocks, columns] = [fields.get(14) ?? 0, fields.get(15) ?? 0];
  const size = [columns * 8, Math.ceil(blocks / columns) * 8];
  if (!(size[0] * size[1] <= MOST_PIXELS)) throw new Error('too large for the test');
  return size;
}

function random(seed) {
  let state = seed;
  return (n) => {
    state ^= state << 13;
    state ^= state >>> 17;
    state ^= state << 5;
    return (state >>> 0) % n;
  };
}

function corrupted(bytes, below) {
  let out = bytes.slice();
  for (let i = below(4); i >= 0; i--) {
    const end = below(2) === 0 ? Math.min(out.length, 300) : out.length;
    const at = below(end);
    const kind = below(8);
    if (kind === 0) out = out.slice(0, Math.max(at, 1));
    else if (kind === 1) out[at] = below(256);
    else out[at] ^= 1 << below(8);
  }
  return out;
}

describe('the WebAssembly decoder', () => {
  const lines = readFileSync(new URL('digests.txt', GOLDEN), 'utf8').trim().split('\n');
  assert.ok(lines.length > 10);
  lines.forEach((line, i) => {
    const [name, intact, variants] = line.split(' ');
    test(`decodes as the native one, intact and corrupted: ${name}`, async () => {
      const bytes = new Uint8Array(readFileSync(new URL(name, GOLDEN)));
      assert.equal(await outcome(bytes), intact);
      const below = random(i + 1);
      const hash = createHash('sha256');
      for (let k = 0; k < VARIANTS; k++) hash.update(await outcome(corrupted(bytes, below)));
      assert.equal(hash.digest('hex'), variants);
    });
  });
});

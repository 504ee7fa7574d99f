// The section of planes, entropy coded. The server's src/atlas/planes.rs, step by step; all on integers.
import { broken } from './protobuf.js';
import { models, RangeDecoder } from './range.js';

/** Set in a tile's count where its last plane is a backstop. */
export const BACKSTOP = 0x80;
const COUNTS = 8;
const COUNT_BITS = 6;
const PLACES = 3;
const SIZES = 5;
const LENGTH_BITS = 5;
const HALF = 0x8000;

/** Planes that the count of a tile stands for. */
export const planesOf = (count) => (count & ~BACKSTOP) + (count >> 7);

/** Models of signed numbers in some contexts: count of bits, sign, the bit after the highest. */
const numbers = (contexts) => ({
  length: models(contexts << LENGTH_BITS),
  sign: models(contexts),
  second: models(contexts << LENGTH_BITS),
});

/**
 * Reads the planes of all tiles.
 * @param {{columns: number, tiles: number, planes: number}} layout tiles in a row and in all, planes of all tiles
 * @returns {Uint8Array} a count for each tile, then columns of 16-bit values, low bytes before high bytes
 */
export function decodePlanes({ columns, tiles, planes }, bytes) {
  const coder = new RangeDecoder(bytes);
  const raw = new Uint8Array(tiles + planes * 6);
  const counts = raw.subarray(0, tiles);
  readCounts(coder, columns, counts);
  if (counts.reduce((sum, count) => sum + planesOf(count), 0) !== planes) broken('wrong count of planes in a tile');
  const [a, b, c] = [numbers(PLACES), numbers(1), numbers(SIZES)];
  const firsts = new Int16Array(tiles);
  let at = tiles;
  for (let t = 0; t < tiles; t++) {
    let last = t % columns ? firsts[t - 1] : t ? firsts[t - columns] : 0;
    const labelled = counts[t] & ~BACKSTOP;
    for (let i = 0; i < planesOf(counts[t]); i++, at++) {
      last = wrapped(last + number(coder, a, i === labelled ? 2 : Math.min(i, 1)));
      if (i === 0) firsts[t] = last;
      const second = number(coder, b, 0);
      const size = Math.min(32 - Math.clz32(Math.abs(second)), 12);
      [last, second, number(coder, c, Math.floor(size / 3))].forEach((value, column) => {
        raw[at + 2 * column * planes] = value & 255;
        raw[at + (2 * column + 1) * planes] = (value >> 8) & 255;
      });
    }
  }
  return raw;
}

function readCounts(coder, columns, counts) {
  const of = models(COUNTS << COUNT_BITS);
  const behind = models(1);
  for (let t = 0; t < counts.length; t++) {
    const left = t % columns ? counts[t - 1] & ~BACKSTOP : 1;
    const above = t < columns ? 1 : counts[t - columns] & ~BACKSTOP;
    const count = tree(coder, of, Math.min(left + above, COUNTS - 1), COUNT_BITS) + 1;
    counts[t] = count | (coder.bit(behind, 0) ? BACKSTOP : 0);
  }
}

const wrapped = (value) => (value << 16) >> 16;

/** A signed number of 16 bits in a context of `of`. */
function number(coder, of, context) {
  const length = tree(coder, of.length, context, LENGTH_BITS);
  if (!length) return 0;
  const negative = coder.bit(of.sign, context);
  const even = models(1);
  let value = 1;
  for (let i = length - 2; i >= 0; i--) {
    // the rest is as likely 0 as 1
    even.fill(HALF);
    const one = i + 2 === length ? coder.bit(of.second, (context << LENGTH_BITS) + length) : coder.bit(even, 0);
    value = (value << 1) | (one ? 1 : 0);
  }
  return wrapped(negative ? -value : value);
}

/** A number of `bits` bits, from the highest. */
function tree(coder, of, context, bits) {
  let node = 1;
  for (let i = 0; i < bits; i++) node = (node << 1) | (coder.bit(of, (context << bits) + node) ? 1 : 0);
  return node - (1 << bits);
}

// Label maps: which plane each pixel of each tile lies on. The server's src/atlas/{labels,bands}.rs, step by step; all on integers.
import { tileCounts, tileRect } from './grid.js';
import { broken } from './protobuf.js';
import { models, RangeDecoder } from './range.js';

const MOST_LABELS = 64;
const CONTEXTS = 32 * 3;

/**
 * Reads the labels of all tiles.
 * @param {{width: number, height: number, tileSize: number, tileStride: number}} grid
 * @param {Uint8Array} counts labels of each tile, 1 to 64
 * @returns {Uint8Array} tile after tile, row by row
 */
export function decodeLabels(grid, counts, bytes) {
  if (counts.length !== tileCounts(grid).tiles || counts.some((c) => c < 1 || c > MOST_LABELS)) {
    broken('a tile must have 1 to 64 planes');
  }
  return walkLabels(grid, counts, new RangeDecoder(bytes));
}

/**
 * Cuts labels in bands of whole rows of tiles into what `decodeBands` takes; the bands know nothing of each other.
 * @param {Array<{rows: number, length: number, check: number}>} bands
 */
export function labelBands(grid, counts, bands, bytes) {
  const { columns, tiles } = tileCounts(grid);
  const sum = (key) => bands.reduce((total, band) => total + band[key], 0);
  if (bands.some(({ rows }) => rows === 0) || sum('rows') * columns !== tiles || counts.length !== tiles) {
    broken('the bands of labels have other rows of tiles than the grid');
  }
  if (sum('length') !== bytes.length) broken('the bands of labels have another length than their section');
  let [row, at] = [0, 0];
  return bands.map(({ rows, length, check }, i) => {
    const height = Math.min((rows - 1) * grid.tileStride + grid.tileSize, grid.height - row * grid.tileStride);
    const own = counts.subarray(row * columns, (row + rows) * columns);
    row += rows;
    const { width, tileSize, tileStride } = grid;
    const name = `band ${i + 1} of ${bands.length}`;
    return { grid: { width, height, tileSize, tileStride }, counts: own, bytes: bytes.subarray(at, (at += length)), check, name };
  });
}

/** Labels of some bands, one after the other. */
export function decodeBands(bands) {
  const parts = bands.map(({ grid, counts, bytes, check, name }) => {
    if (crc32(bytes) !== check) broken(`${name} of the labels is damaged`);
    return decodeLabels(grid, counts, bytes);
  });
  return concatenated(parts);
}

/** One array of all, of their own type. */
export function concatenated(arrays) {
  const out = new arrays[0].constructor(arrays.reduce((sum, a) => sum + a.length, 0));
  let at = 0;
  for (const a of arrays) {
    out.set(a, at);
    at += a.length;
  }
  return out;
}

const CRC_TABLE = Int32Array.from({ length: 256 }, (_, byte) => {
  let value = byte;
  for (let i = 0; i < 8; i++) value = (value >>> 1) ^ (value & 1 ? 0xedb8_8320 : 0);
  return value;
});

/** CRC-32 as in gzip. */
export function crc32(bytes) {
  let value = -1;
  for (let i = 0; i < bytes.length; i++) value = (value >>> 8) ^ CRC_TABLE[(value ^ bytes[i]) & 255];
  return ~value >>> 0;
}

/** The walk over all labels, which is the same for a writer: a coder that writes is told what to write by `want`. */
export function walkLabels(grid, counts, coder, want) {
  const { width, height } = grid;
  const { columns } = tileCounts(grid);
  const rects = Array.from(counts, (_, tile) => tileRect(grid, columns, tile));
  const labels = new Uint8Array(rects.reduce((sum, { w, h }) => sum + w * h, 0));
  const state = {
    width,
    seenTile: new Uint32Array(width * height),
    seenLabel: new Uint8Array(width * height),
    left: models(CONTEXTS),
    above: models(CONTEXTS),
    diagonal: models(CONTEXTS),
    tree: models(MOST_LABELS * 2),
  };
  let first = 0;
  rects.forEach((rect, tile) => {
    const end = first + rect.w * rect.h;
    const own = labels.subarray(first, end);
    if (counts[tile] > 1) tileLabels(rect, counts[tile], own, state, coder, want?.subarray(first, end));
    for (let y = 0; y < rect.h; y++) {
      const row = (rect.y + y) * width + rect.x;
      state.seenTile.fill(tile + 1, row, row + rect.w);
      state.seenLabel.set(own.subarray(y * rect.w, (y + 1) * rect.w), row);
    }
    first = end;
  });
  return labels;
}

/** 0 unknown, 1 the same label at both pixels in the tile seen before, 2 an edge between them. */
function edge({ seenTile, seenLabel }, p, q) {
  if (seenTile[p] === 0 || seenTile[p] !== seenTile[q]) return 0;
  return seenLabel[p] === seenLabel[q] ? 1 : 2;
}

function tileLabels(rect, count, own, state, coder, want) {
  const { w, h } = rect;
  own[0] = spell(state, count, coder, want?.[0]);
  for (let y = 0; y < h; y++) {
    for (let x = y === 0 ? 1 : 0; x < w; x++) {
      const at = y * w + x;
      const p = (rect.y + y) * state.width + rect.x + x;
      const l = x > 0 ? own[at - 1] : own[at - w];
      const a = y > 0 ? own[at - w] : own[at - 1];
      const corner = x > 0 && y > 0 ? own[at - w - 1] : l;
      const right = y > 0 && x + 1 < w ? own[at - w + 1] : a;
      const left2 = x > 1 ? own[at - 2] : l;
      const above2 = y > 1 ? own[at - 2 * w] : a;
      const edgeLeft = x > 0 ? edge(state, p, p - 1) : 0;
      const edgeAbove = y > 0 ? edge(state, p, p - state.width) : 0;
      const agree = (l === a) | ((a === corner) << 1) | ((a === right) << 2) | ((l === left2) << 3) | ((a === above2) << 4);
      const context = agree * 3;
      if (coder.bit(state.left, context + edgeLeft, want?.[at] === l)) {
        own[at] = l;
        continue;
      }
      if (a !== l && coder.bit(state.above, context + edgeAbove, want?.[at] === a)) {
        own[at] = a;
        continue;
      }
      const diagonal = right !== l && right !== a ? right : corner;
      if (diagonal !== l && diagonal !== a && coder.bit(state.diagonal, context + edgeAbove, want?.[at] === diagonal)) {
        own[at] = diagonal;
      } else {
        own[at] = spell(state, count, coder, want?.[at]);
      }
    }
  }
}

function spell({ tree }, count, coder, want) {
  let node = 1;
  let value = 0;
  for (let i = 32 - Math.clz32(count - 1); i > 0; i--) {
    const bit = coder.bit(tree, node, ((want >> (i - 1)) & 1) === 1) ? 1 : 0;
    node = (node << 1) | bit;
    value = (value << 1) | bit;
  }
  return Math.min(value, count - 1);
}

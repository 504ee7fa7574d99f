// Label maps, entropy coded: the reader of src/atlas/range.rs and src/atlas/labels.rs; both must agree bit for bit.
import { broken } from './protobuf.js';
import { tileCounts, tileRect } from './grid.js';

const QUICK = 4;
const SLOW = 7;
/** Below this range the coder takes in a byte. */
const BOTTOM = 2 ** 24;
/** Contexts of a question: five bits of agreement, three states of the overlapping tile. */
const CONTEXTS = 32 * 3;
/** Most labels of a tile. */
const TREE = 64;

/** Where the adaptive bits of each question begin. */
const LEFT = 0;
const ABOVE = CONTEXTS;
const DIAGONAL = 2 * CONTEXTS;
const SPELL = 3 * CONTEXTS;
const BITS = SPELL + 2 * TREE;

/** Adaptive binary range decoder; reads zeros beyond the end. */
class Decoder {
  constructor(data) {
    this.data = data;
    this.at = 0;
    this.code = 0;
    this.range = 0xffff_ffff;
    this.quick = new Uint16Array(BITS).fill(1 << 15);
    this.slow = new Uint16Array(BITS).fill(1 << 15);
    for (let i = 0; i < 4; i++) this.#shift();
  }

  /** Reads one bit by the model `m`. */
  get(m) {
    const { quick, slow } = this;
    const share = Math.min(4095, Math.max(1, (quick[m] + slow[m]) >> 5));
    const split = (this.range >>> 12) * share;
    const bit = this.code < split;
    if (bit) {
      this.range = split;
      quick[m] += (65_535 - quick[m]) >> QUICK;
      slow[m] += (65_535 - slow[m]) >> SLOW;
    } else {
      this.code -= split;
      this.range -= split;
      quick[m] -= quick[m] >> QUICK;
      slow[m] -= slow[m] >> SLOW;
    }
    while (this.range < BOTTOM) {
      this.range = (this.range << 8) >>> 0;
      this.#shift();
    }
    return bit;
  }

  #shift() {
    const next = this.at < this.data.length ? this.data[this.at++] : 0;
    this.code = ((this.code << 8) | next) >>> 0;
  }
}

/**
 * Reads the labels of all tiles, row by row within each tile, tile after tile.
 * @param {{width: number, height: number, tileSize: number, tileStride: number}} grid
 * @param {Uint8Array} counts labels of each tile, 1 to 64
 * @param {Uint8Array} data
 * @returns {Uint8Array}
 */
export function decodeLabels(grid, counts, data) {
  const { width, height } = grid;
  const { columns, tiles } = tileCounts(grid);
  if (counts.length !== tiles || counts.some((count) => count < 1 || count > TREE)) broken('labels: a tile must have 1 to 64 of them');
  const rects = Array.from({ length: tiles }, (_, tile) => tileRect(grid, columns, tile));
  const labels = new Uint8Array(rects.reduce((total, r) => total + r.w * r.h, 0));
  // what earlier tiles said of each pixel: tile number plus one, and label
  const seen = { width, tile: new Uint32Array(width * height), label: new Uint8Array(width * height) };
  const decoder = new Decoder(data);
  let first = 0;
  rects.forEach((rect, tile) => {
    const own = labels.subarray(first, first + rect.w * rect.h);
    first += own.length;
    if (counts[tile] > 1) tileLabels(rect, counts[tile], own, seen, decoder);
    for (let y = 0; y < rect.h; y++) {
      const row = (rect.y + y) * width + rect.x;
      seen.tile.fill(tile + 1, row, row + rect.w);
      seen.label.set(own.subarray(y * rect.w, (y + 1) * rect.w), row);
    }
  });
  return labels;
}

/** 0 unknown, 1 the same label at both pixels, 2 an edge between them. */
function edge(seen, p, q) {
  if (seen.tile[p] === 0 || seen.tile[p] !== seen.tile[q]) return 0;
  return seen.label[p] === seen.label[q] ? 1 : 2;
}

function tileLabels({ x: x0, y: y0, w, h }, count, own, seen, decoder) {
  for (let y = 0; y < h; y++) {
    for (let x = 0; x < w; x++) {
      const i = y * w + x;
      if (i === 0) {
        own[0] = spell(decoder, count);
        continue;
      }
      // at a border one neighbour stands for the other
      const left = x > 0 ? own[i - 1] : own[i - w];
      const above = y > 0 ? own[i - w] : left;
      const corner = x > 0 && y > 0 ? own[i - w - 1] : left;
      const right = y > 0 && x + 1 < w ? own[i - w + 1] : above;
      const left2 = x > 1 ? own[i - 2] : left;
      const above2 = y > 1 ? own[i - 2 * w] : above;
      const agree = (left === above) + 2 * (above === corner) + 4 * (above === right) + 8 * (left === left2) + 16 * (above === above2);
      const p = (y0 + y) * seen.width + x0 + x;
      const edgeLeft = x > 0 ? edge(seen, p, p - 1) : 0;
      const edgeAbove = y > 0 ? edge(seen, p, p - seen.width) : 0;
      const diagonal = right !== left && right !== above ? right : corner;
      if (decoder.get(LEFT + agree * 3 + edgeLeft)) own[i] = left;
      else if (above !== left && decoder.get(ABOVE + agree * 3 + edgeAbove)) own[i] = above;
      else if (diagonal !== left && diagonal !== above && decoder.get(DIAGONAL + agree * 3 + edgeAbove)) own[i] = diagonal;
      else own[i] = spell(decoder, count);
    }
  }
}

/** A label from scratch, bit by bit from the highest; what a damaged stream spells beyond the count becomes the last label. */
function spell(decoder, count) {
  const bits = 32 - Math.clz32(count - 1);
  let node = 1;
  let value = 0;
  for (let i = 0; i < bits; i++) {
    const bit = decoder.get(SPELL + node) ? 1 : 0;
    node = node * 2 + bit;
    value = value * 2 + bit;
  }
  return Math.min(value, count - 1);
}

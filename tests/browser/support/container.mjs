// A container written by hand from proto/tmpi.proto; that the server's come out the same is held against tests/golden.
import { walkLabels } from '../../../static/decode/labels.js';
import { peel } from '../../../static/decode/peel.js';
import { learn, share } from '../../../static/decode/range.js';
import { BOX, boxPhoto, inBox, png, wall } from './pictures.mjs';

const varint = (value) => {
  const out = [];
  for (let v = BigInt(value); ; v >>= 7n) {
    if (v < 128n) return Buffer.from([...out, Number(v)]);
    out.push(Number(v & 127n) | 128);
  }
};
const uint = (field, value) => Buffer.concat([varint(field * 8), varint(value)]);
const bytesField = (field, bytes) => Buffer.concat([varint(field * 8 + 2), varint(bytes.length), bytes]);
const double = (field, value) => {
  const body = Buffer.alloc(8);
  body.writeDoubleLE(value);
  return Buffer.concat([varint(field * 8 + 1), body]);
};

/** A zstd frame of stored blocks. */
export function zstdStored(bytes) {
  const head = Buffer.from([0x28, 0xb5, 0x2f, 0xfd, 0xa0, 0, 0, 0, 0]);
  head.writeUInt32LE(bytes.length, 5);
  const parts = [head];
  const MOST = 100_000;
  for (let at = 0; at === 0 || at < bytes.length; at += MOST) {
    const block = bytes.subarray(at, at + MOST);
    const last = at + MOST >= bytes.length ? 1 : 0;
    const size = (block.length << 3) | last;
    parts.push(Buffer.from([size & 255, (size >> 8) & 255, (size >> 16) & 255]), block);
  }
  return Buffer.concat(parts);
}

const KINDS = { photo: 1, planes: 2, labels: 3, alpha: 4, hidden: 5 };
const CODECS = { raw: 0, zstd: 1, png: 3, range: 5 };

/** Header, index and sections. */
export function assemble(index, sections, { major = 1 } = {}) {
  let offset = 0;
  const written = sections.map(({ kind, codec, bytes, rawLength = 0 }) => {
    const message = [uint(1, KINDS[kind]), uint(2, CODECS[codec]), uint(3, offset), uint(4, bytes.length), uint(5, rawLength)];
    offset += bytes.length;
    return bytesField(16, Buffer.concat(message));
  });
  const doubles = new Set([5, 6, 7, 8, 9, 10, 11]);
  const fields = index.map((value, i) => (doubles.has(i + 1) ? double(i + 1, value) : uint(i + 1, value)));
  // a field of a later version, to be ignored
  const body = Buffer.concat([...fields, ...written, uint(99, 7)]);
  const head = Buffer.alloc(12);
  head.write('TMPI', 'latin1');
  head.writeUInt16LE(major, 4);
  head.writeUInt32LE(body.length, 8);
  return Buffer.concat([head, body, ...sections.map((s) => s.bytes)]);
}

/** Writes bits for the walk over labels. */
class RangeEncoder {
  constructor() {
    this.low = 0;
    this.range = 0xffff_ffff;
    this.digits = [];
  }

  bit(models, i, one) {
    const split = (this.range >>> 12) * share(models, i);
    if (one) {
      this.range = split;
    } else {
      this.low += split;
      this.range -= split;
    }
    learn(models, i, one);
    while (this.range < 0x100_0000) {
      this.range = (this.range << 8) >>> 0;
      this.shift();
    }
    return one;
  }

  /** Moves the top byte out; a carry runs through those already there. */
  shift() {
    if (this.low >= 2 ** 32) {
      let at = this.digits.length - 1;
      while (this.digits[at] === 255) this.digits[at--] = 0;
      this.digits[at]++;
      this.low -= 2 ** 32;
    }
    this.digits.push(Math.floor(this.low / 2 ** 24));
    this.low = (this.low % 2 ** 24) * 256;
  }

  finish() {
    for (let i = 0; i < 4; i++) this.shift();
    return Buffer.from(this.digits);
  }
}

/** The box before the wall: per tile the wall, and the box where it reaches into the tile. */
export function boxScene(width = 200, height = 120, size = 64) {
  const stride = size - size / 8;
  const count = (length) => (length <= size ? 1 : Math.ceil((length - size) / stride) + 1);
  const plane = (delta) => ({ a: Math.round(delta * 16384) / 16384, b: 0, c: 0 });
  const tiles = [];
  for (let tile = 0; tile < count(width) * count(height); tile++) {
    const [x, y] = [(tile % count(width)) * stride, Math.floor(tile / count(width)) * stride];
    const rect = { x, y, w: Math.min(size, width - x), h: Math.min(size, height - y) };
    const labels = Uint8Array.from({ length: rect.w * rect.h }, (_, i) =>
      inBox(x + (i % rect.w), y + Math.floor(i / rect.w), width, height) ? 1 : 0,
    );
    const planes = labels.includes(1) ? [plane(BOX.far), plane(BOX.near)] : [plane(BOX.far)];
    tiles.push({ rect, planes, labels, backstop: null });
  }
  const focal = 0.58 * width;
  const head = {
    width,
    height,
    tileSize: size,
    tileStride: stride,
    intrinsics: { fx: focal, fy: focal, cx: width / 2, cy: height / 2 },
    viewBox: { x: 0.03, y: 0.03, z: 0.03 },
  };
  return { ...head, tiles, layers: peel(head, tiles) };
}

/** The scene as a container; `change(index, sections)` may alter either before they are written. */
export function container(scene, options) {
  const { width, height, tileSize, tileStride, tiles, layers, intrinsics: k, viewBox: v } = scene;
  const all = tiles.flatMap((t) => t.planes);
  const planes = Buffer.alloc(tiles.length + all.length * 6);
  tiles.forEach((t, i) => (planes[i] = t.planes.length));
  ['a', 'b', 'c'].forEach((key, column) =>
    all.forEach((plane, i) => {
      const at = tiles.length + column * 2 * all.length + i;
      const value = Math.round(plane[key] * 16384);
      planes[at] = value & 255;
      planes[at + all.length] = (value >> 8) & 255;
    }),
  );
  const coder = new RangeEncoder();
  const counts = tiles.map((t) => t.planes.length);
  walkLabels(scene, Uint8Array.from(counts), coder, Buffer.concat(tiles.map((t) => t.labels)));
  const blocks = hiddenBlocks(layers);
  const perRow = 7;
  const hidden = png(perRow * 8, Math.max(1, Math.ceil(blocks.length / perRow)) * 8, 3, (x, y) => {
    const block = blocks[Math.floor(y / 8) * perRow + Math.floor(x / 8)];
    return block ? wall(block[0] + (x % 8), block[1] + (y % 8)) : [0, 0, 0];
  });
  const index = [width, height, tileSize, tileStride, k.fx, k.fy, k.cx, k.cy, v.x, v.y, v.z, all.length, 0, blocks.length, perRow];
  const sections = [
    { kind: 'photo', codec: 'png', bytes: boxPhoto(width, height) },
    { kind: 'planes', codec: 'zstd', bytes: zstdStored(planes), rawLength: planes.length },
    { kind: 'labels', codec: 'range', bytes: coder.finish() },
    { kind: 'hidden', codec: 'png', bytes: hidden },
  ];
  options?.change?.(index, sections);
  return assemble(index, sections, options);
}

/** Corners of the 8×8 cells with a hidden texel, in the container's order. */
function hiddenBlocks(layers) {
  const out = [];
  for (const l of layers) {
    for (let cy = l.y - (l.y % 8); cy < l.y + l.h; cy += 8) {
      for (let cx = l.x - (l.x % 8); cx < l.x + l.w; cx += 8) {
        const any = l.classes.some((kind, i) => {
          const [x, y] = [l.x + (i % l.w), l.y + Math.floor(i / l.w)];
          return kind === 2 && x >= cx && x < cx + 8 && y >= cy && y < cy + 8;
        });
        if (any) out.push([cx, cy]);
      }
    }
  }
  return out;
}

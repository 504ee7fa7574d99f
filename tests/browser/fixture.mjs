// A container written by hand from proto/tmpi.proto, so that the decoder is not held against its own kind.
import { boxPhoto, BOX, inBox, png, wall } from './pictures.mjs';

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

const KINDS = { photo: 1, planes: 2, classes: 3, alpha: 4, hidden: 5 };
const CODECS = { raw: 0, zstd: 1, png: 3 };

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

/** The box before the wall: per tile the wall, hidden where the box is, and the box with a soft rim. */
export function boxScene(width = 200, height = 120, size = 64) {
  const stride = size - size / 8;
  const columns = width <= size ? 1 : Math.ceil((width - size) / stride) + 1;
  const rows = height <= size ? 1 : Math.ceil((height - size) / stride) + 1;
  const layers = [];
  for (let tile = 0; tile < columns * rows; tile++) {
    const [x, y] = [(tile % columns) * stride, Math.floor(tile / columns) * stride];
    const [w, h] = [Math.min(size, width - x), Math.min(size, height - y)];
    const cover = [];
    for (let v = 0; v < h; v++) for (let u = 0; u < w; u++) cover.push(inBox(x + u, y + v, width, height));
    layers.push({ tile, delta: BOX.far, x, y, w, h, texels: cover.map((c) => ({ code: c ? 2 : 1 })) });
    if (!cover.includes(true)) continue;
    const rim = (u, v) => [[-1, 0], [1, 0], [0, -1], [0, 1]].some(([du, dv]) => cover[(v + dv) * w + u + du] && u + du >= 0 && u + du < w);
    const texels = cover.map((c, i) => (c ? { code: 1 } : rim(i % w, Math.floor(i / w)) ? { code: 3, alpha: 85 } : { code: 0 }));
    layers.push({ tile, delta: BOX.near, x, y, w, h, texels });
  }
  return { width, height, size, stride, layers };
}

/** The scene as a container; `change(index, sections)` may alter either before they are written. */
export function container(scene, options) {
  const { width, height, size, stride, layers } = scene;
  const n = layers.length;
  const planes = Buffer.alloc(n * 16);
  const put = (column, i, value) => {
    planes[column * 2 * n + i] = value & 255;
    planes[column * 2 * n + n + i] = (value >> 8) & 255;
  };
  const columns = width <= size ? 1 : Math.ceil((width - size) / stride) + 1;
  let last = 0;
  layers.forEach((l, i) => {
    const values = [l.tile - last, Math.round(l.delta * 16384), 0, 0];
    values.push(l.x - (l.tile % columns) * stride, l.y - Math.floor(l.tile / columns) * stride, l.w, l.h);
    last = l.tile;
    values.forEach((value, column) => put(column, i, value));
  });
  const texels = layers.flatMap((l) => l.texels);
  const classes = Buffer.from(texels.map((t) => t.code));
  const alpha = Buffer.from(texels.filter((t) => t.code > 2).map((t) => t.alpha));
  const blocks = hiddenBlocks(layers);
  const perRow = 7;
  const hidden = png(perRow * 8, Math.max(1, Math.ceil(blocks.length / perRow)) * 8, 3, (x, y) => {
    const block = blocks[Math.floor(y / 8) * perRow + Math.floor(x / 8)];
    return block ? wall(block[0] + (x % 8), block[1] + (y % 8)) : [0, 0, 0];
  });
  const focal = 0.58 * width;
  const index = [width, height, size, stride, focal, focal, width / 2, height / 2, 0.03, 0.03, 0.03, n, texels.length, blocks.length, perRow];
  const sections = [
    { kind: 'photo', codec: 'png', bytes: boxPhoto(width, height) },
    { kind: 'planes', codec: 'zstd', bytes: zstdStored(planes), rawLength: planes.length },
    { kind: 'classes', codec: 'zstd', bytes: zstdStored(classes), rawLength: classes.length },
    { kind: 'alpha', codec: 'raw', bytes: alpha, rawLength: alpha.length },
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
        const any = l.texels.some((t, i) => {
          const [x, y] = [l.x + (i % l.w), l.y + Math.floor(i / l.w)];
          return (t.code === 2 || t.code === 4) && x >= cx && x < cx + 8 && y >= cy && y < cy + 8;
        });
        if (any) out.push([cx, cy]);
      }
    }
  }
  return out;
}

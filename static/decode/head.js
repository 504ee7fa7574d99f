// Reads the head of a container (proto/tmpi.proto), so that the photo can be shown before the decoder is loaded, or without it. The decoder
// parses and checks the head itself.

/** @import { SceneHead } from './scene.js' */

/** The data is damaged, of a newer version, or not a container. */
export class ContainerError extends Error {}

/** Newest supported major version, and the limits of crates/core's `container`. */
const MAJOR = 1;
const MAX_INDEX_BYTES = 1 << 20;
const MAX_SIDE = 16_384;
const MAX_PIXELS = 50_000_000;
const HEADER_BYTES = 12;
const MAGIC = [0x54, 0x4d, 0x50, 0x49];
/** Kinds of sections (`Kind` in proto/tmpi.proto). */
const [PHOTO, PLANES, ALPHA, HIDDEN] = [1, 2, 4, 5];
/** The codec that the decoder does not support. */
const ZSTD = 1;
/**
 * Media types of the picture codecs.
 * @type {Record<number, string | undefined>}
 */
const PICTURES = { 2: 'image/jpeg', 3: 'image/png', 4: 'image/webp' };
/** Field number of the sections in the index. */
const SECTIONS = 16;
/** Limits of the reach, and the pixels added to it (crates/core/src/layers/reach.rs). */
const [NEAREST, FARTHEST, MARGIN] = [96, 1664, 1.5];

/** @typedef {{start: number, end: number, type: string}} PictureFile first byte, end and media type of a picture file in a container */
/**
 * The scene's head, how many rows of pixels above and below a tile its layers depend on, total count of bytes, picture files, whether a
 * section must be decompressed (unpack.js), and whether tiles can be decoded in bands, which is not possible if a section covers all texels in
 * one stream.
 * @typedef {{scene: SceneHead, reach: number, bytes: number, photo: PictureFile, hidden: PictureFile | null, packed: boolean,
 *   bands: boolean}} Head
 */

/**
 * @param {string} what
 * @returns {never}
 */
function broken(what) {
  throw new ContainerError(`not a readable TMPI container: ${what}`);
}

/**
 * Reads header and index.
 * @param {Uint8Array} bytes the first bytes of a container
 * @returns {Head | null} null if more bytes are needed
 */
export function readHead(bytes) {
  if (MAGIC.some((byte, i) => i < bytes.length && bytes[i] !== byte)) broken('it does not begin with "TMPI"');
  if (bytes.length < HEADER_BYTES) return null;
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  const major = view.getUint16(4, true);
  if (major > MAJOR) throw new ContainerError(`the container is of version ${major}; this program reads up to version ${MAJOR}`);
  const start = HEADER_BYTES + view.getUint32(8, true);
  if (start - HEADER_BYTES > MAX_INDEX_BYTES) broken('the index is too long');
  if (bytes.length < start) return null;
  const fields = message(view, HEADER_BYTES, start);
  /** @param {number} field */
  const one = (field) => fields.numbers.findLast(([number]) => number === field)?.[1] ?? 0;
  const [width, height, tileSize, tileStride] = [1, 2, 3, 4].map((field) => one(field) % 2 ** 32);
  const [fx, fy, cx, cy, x, y, z] = [5, 6, 7, 8, 9, 10, 11].map(one);
  if (!(width > 0 && height > 0) || width > MAX_SIDE || height > MAX_SIDE || width * height > MAX_PIXELS)
    broken('photo size out of bounds');
  if (!tileSize || tileStride * 2 < tileSize || tileStride > tileSize) broken('tile size out of bounds');
  if (![fx, fy, cx, cy, x, y, z].every(Number.isFinite)) broken('camera out of bounds');
  const sections = fields.ranges
    .filter(([field]) => field === SECTIONS)
    .map(([, from, to]) => {
      const own = Object.fromEntries(message(view, from, to).numbers);
      const first = start + (own[3] ?? 0);
      return { kind: own[1], codec: own[2], type: PICTURES[own[2]], start: first, end: first + (own[4] ?? 0) };
    });
  const [photo, hidden] = [PHOTO, HIDDEN].map((kind) => picture(sections.find((section) => section.kind === kind)));
  if (!photo) return broken('there is no photo section');
  return {
    scene: { width, height, tileSize, tileStride, intrinsics: { fx, fy, cx, cy }, viewBox: { x, y, z } },
    reach: reach(height, { fy, cy }, { y, z }),
    bytes: sections.reduce((end, section) => Math.max(end, section.end), start),
    photo,
    hidden,
    packed: sections.some(({ kind, codec }) => codec === ZSTD && (kind === PLANES || kind === ALPHA)),
    bands: !sections.some(({ kind }) => kind === ALPHA || kind === HIDDEN),
  };
}

/**
 * How many rows of pixels a camera of the view box can look past an edge.
 * @param {number} height
 * @param {{fy: number, cy: number}} intrinsics
 * @param {{y: number, z: number}} viewBox
 */
function reach(height, { fy, cy }, { y, z }) {
  const farthest = fy * y + Math.max(Math.abs(cy), Math.abs(height - cy)) * Math.min(z, 1);
  return Math.min(Math.max(Math.ceil(farthest + MARGIN), NEAREST), FARTHEST);
}

/**
 * The picture file of a section; null if it is not a picture.
 * @param {{start: number, end: number, type: string | undefined} | undefined} section
 * @returns {PictureFile | null}
 */
function picture(section) {
  return section?.type ? { start: section.start, end: section.end, type: section.type } : null;
}

/**
 * The fields of a protobuf message, in order: `[field, value]` of numbers, `[field, start, end]` of length-delimited fields.
 * @param {DataView} view
 * @param {number} from
 * @param {number} to
 */
function message(view, from, to) {
  /** @type {[number, number][]} */
  const numbers = [];
  /** @type {[number, number, number][]} */
  const ranges = [];
  let at = from;
  const varint = () => {
    let value = 0n;
    for (let i = 0n; i < 10n; i++) {
      if (at >= to) broken('index: cut off');
      const byte = view.getUint8(at++);
      if (i === 9n && byte > 1) break;
      value |= BigInt(byte & 127) << (7n * i);
      if (byte < 128) return value;
    }
    return broken('index: a number is too long');
  };
  while (at < to) {
    const key = Number(varint());
    const [field, wire] = [Math.floor(key / 8), key % 8];
    if (wire === 0) {
      numbers.push([field, Number(varint())]);
      continue;
    }
    const length = wire === 1 ? 8 : wire === 5 ? 4 : wire === 2 ? Number(varint()) : broken('index: an unknown type');
    if (at + length > to) broken('index: cut off');
    if (wire === 1) numbers.push([field, view.getFloat64(at, true)]);
    else ranges.push([field, at, at + length]);
    at += length;
  }
  return { numbers, ranges };
}

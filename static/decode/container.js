// Container → scene (schema and layout in proto/tmpi.proto). Pure: no page, no network; pictures are decoded by the caller.
import { cutIntoBands, joined, resultBuffers, work } from './bands.js';
import { tileCounts, tileRect } from './grid.js';
import { concatenated, decodeLabels, labelBands } from './labels.js';
import { checkWork } from './peel.js';
import { BACKSTOP, decodePlanes, planesOf } from './planes.js';
import { broken, ContainerError, readMessage } from './protobuf.js';
import { Class } from './scene.js';
import { decompress } from '../vendor/fzstd.js';

export { Class, ContainerError };

/** Major version that this reader knows. */
export const MAJOR = 1;
/** Longest side and most pixels of a photo; all bounds are those of the server's reader. */
const MAX_SIDE = 16_384;
const MAX_PIXELS = 50_000_000;
const MAX_PLANES = 4_000_000;
const MAX_INDEX_BYTES = 1 << 20;
const MAX_SECTIONS = 64;
/** Step of the plane coefficients. */
const PLANE_STEP = 1 / 16_384;
const HEADER_BYTES = 12;
/** A zstd block has at least 4 bytes and holds at most 128 KiB. */
const ZSTD_LEAST_BLOCK = 4;
const ZSTD_MOST_CONTENT = 131_072;
/** Bytes of a plane. */
const PLANE_BYTES = 6;
const MAX_TILE_PLANES = 65;

export const Kind = { PHOTO: 1, PLANES: 2, LABELS: 3, ALPHA: 4, HIDDEN: 5 };
const KIND_NAMES = { 1: 'photo', 2: 'planes', 3: 'labels', 4: 'alpha', 5: 'hidden' };
const Codec = { RAW: 0, ZSTD: 1, RANGE: 5, RANGE_BANDS: 6 };
/** Media types of the picture codecs. */
const PICTURES = { 2: 'image/jpeg', 3: 'image/png', 4: 'image/webp' };

const SECTION = {
  1: ['kind', 'u32'],
  2: ['codec', 'u32'],
  3: ['offset', 'u64'],
  4: ['length', 'u64'],
  5: ['rawLength', 'u64'],
  6: ['bands', { 1: ['rows', 'u32'], 2: ['length', 'u32'], 3: ['check', 'u32'] }],
};
const INDEX = {
  1: ['width', 'u32'],
  2: ['height', 'u32'],
  3: ['tileSize', 'u32'],
  4: ['tileStride', 'u32'],
  5: ['fx', 'double'],
  6: ['fy', 'double'],
  7: ['cx', 'double'],
  8: ['cy', 'double'],
  9: ['viewX', 'double'],
  10: ['viewY', 'double'],
  11: ['viewZ', 'double'],
  12: ['planes', 'u32'],
  14: ['hiddenBlocks', 'u32'],
  15: ['hiddenColumns', 'u32'],
  16: ['sections', SECTION],
};

/**
 * Reads header and index.
 * @param {Uint8Array} bytes the first bytes of a container
 * @returns {{index: object, start: number} | null} null where more bytes are needed; `start` is where the sections begin
 */
export function readIndex(bytes) {
  const magic = [0x54, 0x4d, 0x50, 0x49];
  for (let i = 0; i < Math.min(4, bytes.length); i++) if (bytes[i] !== magic[i]) broken('it does not start with "TMPI"');
  if (bytes.length < HEADER_BYTES) return null;
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  const major = view.getUint16(4, true);
  if (major > MAJOR) {
    throw new ContainerError(`the container is of version ${major}; this program reads up to version ${MAJOR}`);
  }
  if (major === 0) broken('version 0');
  const length = view.getUint32(8, true);
  if (length > MAX_INDEX_BYTES) broken(`index of ${length} bytes`);
  const start = HEADER_BYTES + length;
  if (bytes.length < start) return null;
  const index = readMessage(bytes.subarray(HEADER_BYTES, start), INDEX);
  checkIndex(index);
  return { index, start };
}

function checkIndex(index) {
  const { width, height, tileSize, tileStride } = index;
  if (!width || !height || width > MAX_SIDE || height > MAX_SIDE || width * height > MAX_PIXELS) {
    broken(`photo of ${width} × ${height} pixels`);
  }
  if (!tileSize || tileSize > MAX_SIDE || tileStride * 2 < tileSize || tileStride > tileSize) broken(`tiles of ${tileSize} pixels every ${tileStride}`);
  for (const name of ['fx', 'fy', 'cx', 'cy', 'viewX', 'viewY', 'viewZ']) {
    if (!Number.isFinite(index[name])) broken(`${name} is not a number`);
  }
  if (index.fx <= 0 || index.fy <= 0) broken('focal length');
  if (index.viewX < 0 || index.viewY < 0 || index.viewZ < 0) broken('view box');
  if (index.planes > MAX_PLANES) broken(`${index.planes} planes`);
  if (index.sections.length > MAX_SECTIONS) broken(`${index.sections.length} sections`);
}

/** The first section of a kind, or undefined. */
function sectionOf(index, kind) {
  return index.sections.find((s) => s.kind === kind);
}

/** Count of bytes from the start of the container to the end of the section of `kind`. */
export function endOfSection(head, kind) {
  const section = sectionOf(head.index, kind);
  return section ? head.start + section.offset + section.length : head.start;
}

/** Count of bytes of the whole container. */
export function endOfAll(head) {
  return head.index.sections.reduce((end, s) => Math.max(end, head.start + s.offset + s.length), head.start);
}

function payload(bytes, head, section) {
  const from = head.start + section.offset;
  const to = from + section.length;
  if (!(to <= bytes.length)) broken(`the ${KIND_NAMES[section.kind]} section ends after the last byte`);
  return bytes.subarray(from, to);
}

/** The picture file of a section: `{bytes, type}`. */
export function picture(bytes, head, kind) {
  const section = sectionOf(head.index, kind);
  if (!section) broken(`no ${KIND_NAMES[kind]} section`);
  const type = PICTURES[section.codec];
  if (!type) broken(`the ${KIND_NAMES[kind]} section has codec ${section.codec}`);
  return { bytes: payload(bytes, head, section), type };
}

/** The bytes of a section, decompressed; must come to `length`. */
function unpacked(bytes, head, kind, length) {
  const name = KIND_NAMES[kind];
  const section = sectionOf(head.index, kind);
  if (!section) {
    if (length === 0) return new Uint8Array(0);
    broken(`no ${name} section`);
  }
  if (section.rawLength !== length) broken(`the ${name} section has ${section.rawLength} bytes, not ${length}`);
  const packed = payload(bytes, head, section);
  if (section.codec === Codec.RAW) {
    if (packed.length !== length) broken(`the ${name} section has ${packed.length} bytes, not ${length}`);
    return packed;
  }
  if (section.codec !== Codec.ZSTD) broken(`the ${name} section has codec ${section.codec}`);
  return unzstd(packed, length, name);
}

function unzstd(packed, length, name) {
  const declared = frameContentSize(packed, name);
  if (declared !== length) broken(`the ${name} section unpacks to ${declared} bytes, not ${length}`);
  if (length > (packed.length / ZSTD_LEAST_BLOCK) * ZSTD_MOST_CONTENT) broken(`the ${name} section cannot unpack to ${length} bytes`);
  // a buffer given bounds the output whatever the stream says
  const out = new Uint8Array(length);
  // fzstd compares the buffer with 1, for which every byte of it would be spelt out as text
  out.valueOf = () => 0;
  try {
    decompress(packed, out);
  } catch (error) {
    broken(`the ${name} section: ${error.message}`);
  }
  delete out.valueOf;
  return out;
}

/** Length that a zstd frame declares for its content. */
function frameContentSize(bytes, name) {
  if (bytes.length < 6 || bytes[0] !== 0x28 || bytes[1] !== 0xb5 || bytes[2] !== 0x2f || bytes[3] !== 0xfd) {
    broken(`the ${name} section is no zstd frame`);
  }
  const flags = bytes[4];
  const single = (flags >> 5) & 1;
  const size = flags >> 6 ? 1 << (flags >> 6) : single;
  if (size === 0) broken(`the ${name} section does not declare its length`);
  const at = 5 + (single ? 0 : 1) + [0, 1, 2, 4][flags & 3];
  if (at + size > bytes.length) broken(`the ${name} section is cut off`);
  let value = 0;
  for (let i = size - 1; i >= 0; i--) value = value * 256 + bytes[at + i];
  return size === 2 ? value + 256 : value;
}

/** What the index alone says of a scene. */
export function sceneHead(index) {
  return {
    width: index.width,
    height: index.height,
    tileSize: index.tileSize,
    tileStride: index.tileStride,
    intrinsics: { fx: index.fx, fy: index.fy, cx: index.cx, cy: index.cy },
    viewBox: { x: index.viewX, y: index.viewY, z: index.viewZ },
  };
}

/**
 * Decodes a whole container.
 * @param {Uint8Array} bytes
 * @param {(picture: {bytes: Uint8Array, type: string}) => Promise<{width: number, height: number, data: Uint8ClampedArray}>} decodePicture
 *   straight RGBA of a picture file
 * @param {object | Promise<object>} [photo] the photo where the caller decodes it
 * @param {(job: object, i: number) => object | Promise<object>} [elsewhere] `work`, perhaps on other threads; `i` is below `bands`
 * @param {number} [bands] how many bands are worked on at the same time
 * @returns {Promise<Scene>}
 */
export async function decode(bytes, decodePicture, photo, elsewhere = work, bands = 1) {
  const head = readIndex(bytes);
  if (!head) broken('cut off');
  const { index } = head;
  const scene = sceneHead(index);
  const together = (jobs) => Promise.all(jobs.map(elsewhere ?? work));
  const tiles = await readTiles(bytes, head, together, bands);
  scene.photo = (await photo) ?? (await decodedPicture(bytes, head, Kind.PHOTO, decodePicture));
  if (scene.photo.width !== index.width || scene.photo.height !== index.height) {
    broken(`the photo is ${scene.photo.width} × ${scene.photo.height} pixels, not ${index.width} × ${index.height}`);
  }
  const carried = sectionOf(index, Kind.HIDDEN);
  const parts = cutIntoBands(scene, tiles, bands, !carried);
  Object.assign(scene, joined(await together(parts)));
  refineAlpha(bytes, head, scene);
  if (carried) {
    const hidden = scene.classes.reduce((n, kind) => n + (kind === Class.HIDDEN), 0);
    const image = hidden ? await decodedPicture(bytes, head, Kind.HIDDEN, decodePicture) : null;
    scene.hidden = readHidden(scene, index, hidden, image);
  }
  return scene;
}

async function decodedPicture(bytes, head, kind, decodePicture) {
  const file = picture(bytes, head, kind);
  try {
    return await decodePicture(file);
  } catch (error) {
    return broken(`the ${KIND_NAMES[kind]} picture: ${error.message}`);
  }
}

/** Planes and labels of all tiles; `together` does up to `bands` jobs at the same time. */
async function readTiles(bytes, head, together, bands) {
  const { index } = head;
  const { planes: n } = index;
  const { columns, tiles: count } = tileCounts(index);
  if (n < count || n > count * MAX_TILE_PLANES) broken(`${n} planes for ${count} tiles`);
  const data = laidOut(bytes, head, { columns, tiles: count, planes: n });
  const counts = data.subarray(0, count).map((c) => c & ~BACKSTOP);
  const total = data.subarray(0, count).reduce((sum, c) => sum + planesOf(c), 0);
  if (total !== n) broken(`${total} planes in the tiles, not ${n}`);
  const coefficient = (column, i) => {
    const at = count + column * 2 * n + i;
    return (((data[at] | (data[at + n] << 8)) << 16) >> 16) * PLANE_STEP;
  };
  const rects = Array.from(counts, (_, t) => tileRect(index, columns, t));
  checkWork(index, rects, counts);
  const labels = await readLabels(bytes, head, counts, together, bands);
  let next = 0;
  let first = 0;
  const plane = () => {
    const i = next++;
    return { a: coefficient(0, i), b: coefficient(1, i), c: coefficient(2, i) };
  };
  return Array.from(counts, (planes, t) => {
    const rect = rects[t];
    const own = labels.subarray(first, (first += rect.w * rect.h));
    return {
      rect,
      planes: Array.from({ length: planes }, plane),
      labels: own,
      backstop: data[t] & BACKSTOP ? plane() : null,
    };
  });
}

/** Counts and columns of all planes. */
function laidOut(bytes, head, layout) {
  const length = layout.tiles + layout.planes * PLANE_BYTES;
  const section = sectionOf(head.index, Kind.PLANES);
  // before minor version 3
  if (section?.codec !== Codec.RANGE) return unpacked(bytes, head, Kind.PLANES, length);
  if (section.rawLength !== length) broken(`the planes section has ${section.rawLength} bytes, not ${length}`);
  return decodePlanes(layout, payload(bytes, head, section));
}

/** Labels of all tiles in a row. */
async function readLabels(bytes, head, counts, together, bands) {
  const { index } = head;
  const section = sectionOf(index, Kind.LABELS);
  if (section?.codec !== Codec.RANGE && section?.codec !== Codec.RANGE_BANDS) broken('no labels section');
  const data = payload(bytes, head, section);
  if (section.codec === Codec.RANGE) return decodeLabels(index, counts, data);
  const all = labelBands(index, counts, section.bands, data);
  const place = (i) => Math.floor((i * all.length) / bands);
  const jobs = Array.from({ length: bands }, (_, i) => ({ labels: all.slice(place(i), place(i + 1)) }));
  const parts = await together(jobs.filter(({ labels }) => labels.length));
  return parts.length === 1 ? parts[0].labels : concatenated(parts.map(({ labels }) => labels));
}

/** Adds a network's refinement to the soft alphas, where there is one. */
function refineAlpha(bytes, head, { alpha }) {
  if (!sectionOf(head.index, Kind.ALPHA)) return;
  const soft = alpha.reduce((n, a) => n + (a > 0 && a < 255), 0);
  const change = unpacked(bytes, head, Kind.ALPHA, soft);
  let next = 0;
  for (let i = 0; i < alpha.length; i++) {
    if (alpha[i] === 0 || alpha[i] === 255) continue;
    alpha[i] += change[next++];
    if (alpha[i] === 0 || alpha[i] === 255) broken('a soft texel has no alpha between 1 and 254');
  }
}

/** RGB of the `count` hidden texels, in the order in which they come; fills `layers.firstHidden`. */
function readHidden(scene, index, count, image) {
  const { layers } = scene;
  const out = new Uint8Array(count * 3);
  if (!count) return out;
  const { hiddenBlocks, hiddenColumns } = index;
  const rows = hiddenColumns ? Math.ceil(hiddenBlocks / hiddenColumns) : 0;
  if (!rows || image.width < hiddenColumns * 8 || image.height < rows * 8) {
    broken(`${hiddenBlocks} blocks do not fit a hidden picture of ${image.width} × ${image.height} pixels`);
  }
  let block = 0;
  let at = 0;
  for (let i = 0; i < layers.count; i++) {
    layers.firstHidden[i] = at / 3;
    const cells = hiddenCells(scene, i, block);
    block = cells.next;
    if (block > hiddenBlocks) broken(`more hidden cells than ${hiddenBlocks}`);
    if (cells.place) at = copyHidden(scene, i, cells, hiddenColumns, image, out, at);
  }
  if (block !== hiddenBlocks) broken(`${block} hidden cells, not ${hiddenBlocks}`);
  return out;
}

/** Numbers the 8×8 cells of layer `i` that hold a hidden texel, from block `first`. */
function hiddenCells({ layers, classes }, i, first) {
  const { x, y, w, h, firstTexel } = layers;
  const columns = ((x[i] + w[i] - 1) >> 3) - (x[i] >> 3) + 1;
  const rows = ((y[i] + h[i] - 1) >> 3) - (y[i] >> 3) + 1;
  let place = null;
  let at = firstTexel[i];
  for (let v = y[i]; v < y[i] + h[i]; v++) {
    const row = ((v >> 3) - (y[i] >> 3)) * columns - (x[i] >> 3);
    for (let u = x[i]; u < x[i] + w[i]; u++) {
      if (classes[at++] !== Class.HIDDEN) continue;
      place ??= new Int32Array(columns * rows).fill(-1);
      place[row + (u >> 3)] = 0;
    }
  }
  let next = first;
  if (place) for (let k = 0; k < place.length; k++) if (place[k] === 0) place[k] = next++;
  return { place, columns, next };
}

function copyHidden({ layers, classes }, i, { place, columns }, blockColumns, image, out, at) {
  const { x, y, w, h, firstTexel } = layers;
  let texel = firstTexel[i];
  for (let v = y[i]; v < y[i] + h[i]; v++) {
    const row = ((v >> 3) - (y[i] >> 3)) * columns - (x[i] >> 3);
    for (let u = x[i]; u < x[i] + w[i]; u++) {
      if (classes[texel++] !== Class.HIDDEN) continue;
      const block = place[row + (u >> 3)];
      const px = (block % blockColumns) * 8 + (u & 7);
      const py = Math.floor(block / blockColumns) * 8 + (v & 7);
      const from = (py * image.width + px) * 4;
      out[at++] = image.data[from];
      out[at++] = image.data[from + 1];
      out[at++] = image.data[from + 2];
    }
  }
  return at;
}

/** Buffers of a scene that can be handed to another thread without a copy. */
export function transferables(scene) {
  return [...new Set([...resultBuffers(scene), scene.photo.data.buffer])];
}

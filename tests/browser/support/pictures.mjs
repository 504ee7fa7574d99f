// Pictures for the tests: a PNG encoder and a synthetic scene.
import { crc32, deflateSync, inflateSync } from 'node:zlib';

const SIGNATURE = Buffer.from([0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a]);

function checksum(bytes) {
  if (crc32) return crc32(bytes);
  let crc = ~0;
  for (const byte of bytes) {
    crc ^= byte;
    for (let k = 0; k < 8; k++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return ~crc >>> 0;
}

function chunk(type, data) {
  const body = Buffer.concat([Buffer.from(type, 'latin1'), data]);
  const out = Buffer.alloc(body.length + 8);
  out.writeUInt32BE(data.length, 0);
  body.copy(out, 4);
  out.writeUInt32BE(checksum(body), body.length + 4);
  return out;
}

/**
 * Encodes an 8-bit PNG.
 * @param {number} channels 1 grey, 3 RGB
 * @param {(x: number, y: number) => number[]} at
 */
export function png(width, height, channels, at) {
  const rows = Buffer.alloc(height * (1 + width * channels));
  for (let y = 0, i = 0; y < height; y++) {
    rows[i++] = 0;
    for (let x = 0; x < width; x++) for (const value of at(x, y)) rows[i++] = Math.max(0, Math.min(255, Math.round(value)));
  }
  return pngOf(width, height, 8, channels === 1 ? 0 : 2, rows);
}

/** Encodes a 16-bit grey PNG from values in [0, 1]. */
export function png16(width, height, at) {
  const rows = Buffer.alloc(height * (1 + width * 2));
  for (let y = 0, i = 0; y < height; y++) {
    rows[i++] = 0;
    for (let x = 0; x < width; x++, i += 2) rows.writeUInt16BE(Math.round(Math.max(0, Math.min(1, at(x, y))) * 65535), i);
  }
  return pngOf(width, height, 16, 0, rows);
}

function pngOf(width, height, depth, colour, rows) {
  const header = Buffer.alloc(13);
  header.writeUInt32BE(width, 0);
  header.writeUInt32BE(height, 4);
  header[8] = depth;
  header[9] = colour;
  return Buffer.concat([SIGNATURE, chunk('IHDR', header), chunk('IDAT', deflateSync(rows)), chunk('IEND', Buffer.alloc(0))]);
}

/** Decodes a PNG of `png` (8 bit, no filter) to RGBA: `{width, height, data}`. */
export function readPng(bytes) {
  const file = Buffer.from(bytes);
  const width = file.readUInt32BE(16);
  const height = file.readUInt32BE(20);
  const channels = file[25] === 0 ? 1 : 3;
  const parts = [];
  for (let at = 8; at < file.length; ) {
    const length = file.readUInt32BE(at);
    if (file.toString('latin1', at + 4, at + 8) === 'IDAT') parts.push(file.subarray(at + 8, at + 8 + length));
    at += length + 12;
  }
  const rows = inflateSync(Buffer.concat(parts));
  const data = new Uint8ClampedArray(width * height * 4);
  for (let i = 0; i < width * height; i++) {
    const from = Math.floor(i / width) + 1 + i * channels;
    for (let c = 0; c < 3; c++) data[i * 4 + c] = rows[from + (channels === 3 ? c : 0)];
    data[i * 4 + 3] = 255;
  }
  return { width, height, data };
}

/** A box in front of a wall: disparity of both, and the box's edges as fractions of the photo. */
export const BOX = { far: 0.1, near: 0.9, x0: 0.35, y0: 0.25, x1: 0.65, y1: 0.8 };

export function inBox(x, y, width, height) {
  const [u, v] = [(x + 0.5) / width, (y + 0.5) / height];
  return u > BOX.x0 && u < BOX.x1 && v > BOX.y0 && v < BOX.y1;
}

/** Colour of the wall, also behind the box; smooth, so that a shift by part of a pixel changes it little. */
export function wall(x, y) {
  return [120 + 70 * Math.sin(x / 9), 110 + 60 * Math.sin(y / 7 + x / 40), 90 + 50 * Math.cos((x + y) / 17)];
}

function box(x, y) {
  return [215 + 25 * Math.sin(x / 5), 90 + 40 * Math.sin(y / 6), 50];
}

/** Photo of the box in front of the wall. */
export function boxPhoto(width, height) {
  return png(width, height, 3, (x, y) => (inBox(x, y, width, height) ? box(x, y) : wall(x, y)));
}

/** Disparity of that photo. */
export function boxDepth(width, height) {
  return png16(width, height, (x, y) => (inBox(x, y, width, height) ? BOX.near : BOX.far));
}

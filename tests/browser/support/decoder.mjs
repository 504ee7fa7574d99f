// The pages' WebAssembly decoder, run in Node.
import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { assembled } from '../../../static/decode/assemble.js';
import { Band } from '../../../static/decode/band.js';
import { Decoder } from '../../../static/decode/decoder.js';
import { tileCounts } from '../../../static/decode/grid.js';
import { readHead } from '../../../static/decode/head.js';
import { unpacked } from '../../../static/decode/unpack.js';

const compile = (name) => new WebAssembly.Module(readFileSync(new URL(`../../../static/decode/${name}`, import.meta.url)));
const decoderModule = compile('decoder.wasm');
const unpacker = compile('unpacker.wasm');

/** The container with all sections unpacked, as the decoder needs it. */
const unpack = (head, bytes) => (head.packed ? unpacked(unpacker, bytes) : bytes);

/** Decodes a container as pages do, in `count` bands; `picture` decodes picture files to RGBA. */
export async function decodeScene(bytes, picture, count = 1) {
  const head = readHead(bytes);
  const decodePicture = async (file) => file && picture(bytes.subarray(file.start, file.end));
  const input = { bytes: await unpack(head, bytes), photo: await decodePicture(head.photo), hidden: await decodePicture(head.hidden) };
  const bands = Array.from({ length: count }, () => new Band(decoderModule));
  return (await assembled(head, input, bands)).scene;
}

/**
 * Decodes layers and texels of a container with one decoder instance; `rows` limits it to a range of tile rows.
 * @param {{photo: object, hidden?: object | null, rows?: number[]}} given pictures as RGBA
 */
export async function decodeTexels(bytes, { photo, hidden = null, rows }) {
  const head = readHead(bytes);
  const decoder = await Decoder.of(decoderModule);
  decoder.open(await unpack(head, bytes));
  decoder.picture('photo', photo);
  if (hidden) decoder.picture('hidden', hidden);
  const { columns, tiles } = tileCounts(head.scene);
  const layers = decoder.decode(head.scene, ...(rows ?? [0, tiles / columns]));
  return { layers, decoder, memory: decoder.memory, ...decoder.texels() };
}

/** The same digest as `Scene::digest` of crates/core. */
export function sceneDigest({ width, tileSize, tileStride }, { layers, classes, alpha, hidden }) {
  const { columns } = tileCounts({ width, height: 1, tileSize, tileStride });
  const hash = createHash('sha256');
  const row = Buffer.alloc(44);
  for (let i = 0; i < layers.count; i++) {
    row.writeUInt32LE((layers.tileY[i] / tileStride) * columns + layers.tileX[i] / tileStride, 0);
    ['a', 'b', 'c'].forEach((key, k) => row.writeDoubleLE(layers[key][i], 4 + 8 * k));
    ['x', 'y', 'w', 'h'].forEach((key, k) => row.writeUInt32LE(layers[key][i], 28 + 4 * k));
    hash.update(row);
  }
  return hash.update(classes).update(alpha).update(hidden).digest('hex');
}

// The page's decoder in node.
import { createHash } from 'node:crypto';
import { readFileSync } from 'node:fs';
import { assembled } from '../../../static/decode/assemble.js';
import { Band } from '../../../static/decode/band.js';
import { Decoder } from '../../../static/decode/decoder.js';
import { tileCounts } from '../../../static/decode/grid.js';
import { readHead } from '../../../static/decode/head.js';
import { unpacked } from '../../../static/decode/unpack.js';

const built = (name) => new WebAssembly.Module(readFileSync(new URL(`../../../static/decode/${name}`, import.meta.url)));
export const module = built('decoder.wasm');
const unpacker = built('unpacker.wasm');

/** What the decoder takes: the container with no section packed. */
const plain = (head, bytes) => (head.packed ? unpacked(unpacker, bytes) : bytes);

/** The scene of a container as pages get it, in `count` bands; `picture` decodes picture files to RGBA. */
export async function scene(bytes, picture, count = 1) {
  const head = readHead(bytes);
  const of = async (file) => file && picture(bytes.subarray(file.start, file.end));
  const input = { bytes: await plain(head, bytes), photo: await of(head.photo), hidden: await of(head.hidden) };
  const bands = Array.from({ length: count }, () => new Band(module));
  return (await assembled(head, input, bands)).scene;
}

/**
 * Layers and texels of a container, and the decoder that has them, by one instance, or the rows of tiles `rows`.
 * @param {{photo: object, hidden?: object | null, rows?: number[]}} given pictures as RGBA
 */
export async function texels(bytes, { photo, hidden = null, rows }) {
  const head = readHead(bytes);
  const decoder = await Decoder.of(module);
  decoder.open(await plain(head, bytes));
  decoder.picture('photo', photo);
  if (hidden) decoder.picture('hidden', hidden);
  const { columns, tiles } = tileCounts(head.scene);
  const layers = decoder.decode(head.scene, ...(rows ?? [0, tiles / columns]));
  return { layers, decoder, memory: decoder.memory, ...decoder.texels() };
}

/** What `Scene::digest` of crates/core gives. */
export function digest({ width, tileSize, tileStride }, { layers, classes, alpha, hidden }) {
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

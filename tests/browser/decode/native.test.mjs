// Compares every layer and texture of the WebAssembly and the native decoder: rendered scenes, and photos if TMPI_DATA has some.
import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { createHash } from 'node:crypto';
import { existsSync, mkdtempSync, readdirSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { dirname, join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { readHead } from '../../../static/decode/head.js';
import { mirrorFlags, pieces } from '../../../static/draw/border.js';
import { pack } from '../../../static/draw/texture-atlas.js';
import { decodeTexels, sceneDigest } from '../support/decoder.mjs';
import { lab, program } from '../support/program.mjs';
import { skip } from '../support/skip.mjs';

const SCENES = 12;
/** Folders of photos in TMPI_DATA, and number of photos to use from each. */
const PHOTOS = { kodak: 8, dav2: 10, tmpi: 2 };
/** Longest side of a photo: small for speed, but with several rows of tiles, borders and corners. */
const SIDE = 400;
const MOST_BYTES = 1 << 28;
/** Numbers per piece. */
const PIECE = 7;
const native = join(dirname(program), 'examples/native');

/** Runs a program; returns its output. */
const run = (file, args, input) => execFileSync(file, args, { input, maxBuffer: MOST_BYTES, stdio: ['pipe', 'pipe', 'ignore'] });

/** Strips of texture pages: size and pieces. */
function stripsOf(head, layers) {
  const all = pieces({ ...head.scene, layers });
  const { bands, width } = pack(all);
  return bands.map(({ pieces: own, x, h: height }) => {
    const numbers = own.flatMap((i, k) => {
      const { layer, u, v, w, h } = all[i];
      return [layer, u, v, w, h, mirrorFlags(all[i]), x[k]];
    });
    return { width, height, numbers };
  });
}

/** Digests of both decoders. */
async function digests(file) {
  const bytes = new Uint8Array(readFileSync(file));
  const head = readHead(bytes);
  const { width, height } = head.scene;
  const photo = { width, height, data: new Uint8Array(run(native, ['pixels', file])) };
  const decoded = await decodeTexels(bytes, { photo });
  const strips = stripsOf(head, decoded.layers);
  const hash = createHash('sha256');
  for (const { numbers, ...size } of strips) hash.update(decoded.decoder.strip(Uint32Array.from(numbers), size.width, size.height));
  const request = strips.flatMap(({ width, height, numbers }) => [width, height, numbers.length / PIECE, ...numbers]);
  const input = Buffer.from(Uint32Array.from(request).buffer);
  const [layers, textures] = run(native, ['digests', file], input).toString().trim().split(' ');
  return { built: [sceneDigest(head.scene, decoded), hash.digest('hex')], native: [layers, textures], hidden: decoded.hidden.length };
}

describe('the WebAssembly and the native decoder', () => {
  let folder = '';
  before(() => {
    assert.ok(existsSync(native), `no ${native}: cargo build --release --workspace --examples makes it`);
    folder = mkdtempSync(join(tmpdir(), 'tmpi-decode-'));
  });
  after(() => rmSync(folder, { recursive: true, force: true }));

  /** Compares all containers in a folder; some texels must be hidden, so that the comparison includes their colours. */
  async function compare(name, count) {
    const files = readdirSync(join(folder, name)).filter((file) => file.endsWith('.tmpi'));
    assert.equal(files.length, count);
    let hidden = 0;
    for (const file of files) {
      const result = await digests(join(folder, name, file));
      assert.deepEqual(result.built, result.native, file);
      hidden += result.hidden;
    }
    assert.ok(hidden > count * 1000, `${hidden} hidden texels`);
  }

  test(`decode ${SCENES} rendered scenes to the same layers and textures`, async () => {
    const rendered = join(folder, 'rendered');
    run(lab, ['synth', '--output', rendered, '--count', String(SCENES)]);
    for (const seed of readdirSync(rendered)) {
      const [photo, depth] = ['photo.png', 'disparity.png'].map((name) => join(rendered, seed, name));
      run(program, ['make', '-q', '-o', join(folder, 'scenes', `${seed}.tmpi`), '--depth', depth, photo]);
    }
    await compare('scenes', SCENES);
  });

  const data = process.env.TMPI_DATA && join(process.env.TMPI_DATA, 'photos');
  test('decode photos to the same layers and textures', async (t) => {
    if (!data || !existsSync(data)) return skip(t, 'data', 'TMPI_DATA has no photos');
    for (const [name, count] of Object.entries(PHOTOS)) {
      const all = readdirSync(join(data, name)).filter((file) => /\.(jpg|png)$/.test(file));
      const photos = all.slice(0, count).map((file) => join(data, name, file));
      run(program, ['make', '-q', '-o', join(folder, name), '--max-size', String(SIDE), ...photos]);
      await compare(name, count);
    }
  });
});

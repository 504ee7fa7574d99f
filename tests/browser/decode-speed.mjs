// Measures the WebAssembly decoder of the pages: size, time compared with the native decoder, memory, main-thread time, and time to the first view
// over a network link. Not a test; run it on an idle machine after `cargo build --release --workspace --examples`:
//   node decode-speed.mjs [--rounds 6] [--runs 4] [--only sizes,decode,page,link] [--mbps 50] [--latency 40] PHOTO|FILE.tmpi…
// Makes containers of each PHOTO in five sizes.
import { execFileSync } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { basename, dirname, join } from 'node:path';
import { parseArgs } from 'node:util';
import { gzipSync } from 'node:zlib';
import { containersOf } from './speed/containers.mjs';
import { decodeRounds } from './speed/decode.mjs';
import { firstViews } from './speed/first-view.mjs';
import { pageTasks } from './speed/page-thread.mjs';
import { STATIC, startSpeedServer } from './speed/server.mjs';
import { program } from './support/program.mjs';

const { values, positionals } = parseArgs({
  allowPositionals: true,
  options: {
    rounds: { type: 'string', default: '6' },
    runs: { type: 'string', default: '4' },
    only: { type: 'string', default: 'sizes,decode,page,link' },
    mbps: { type: 'string', default: '50' },
    latency: { type: 'string', default: '40' },
  },
});
if (!positionals.length) {
  console.error('usage: node decode-speed.mjs [--rounds N] [--runs N] [--only PARTS] PHOTO|FILE.tmpi…');
  process.exit(2);
}
const [rounds, runs] = [values.rounds, values.runs].map(Number);
const parts = values.only.split(',');
/** Measured times of decoding, and the size of photo for the link. */
const TIMES = ['cold', 'again', 'warm', 'pages'];
const LINK_SIZE = '630x350';
/** Users notice longer tasks. */
const FRAME_MS = 16;
const NATIVE_ROUNDS = 10;

const sorted = (list) => list.toSorted((a, b) => a - b);
const median = (list) => {
  const all = sorted(list);
  return (all[(all.length - 1) >> 1] + all[all.length >> 1]) / 2;
};
const range = (list) => `${median(list).toFixed(1)} ms (${Math.min(...list).toFixed(1)}–${Math.max(...list).toFixed(1)})`;

function sizes() {
  for (const name of ['decoder.wasm', 'unpacker.wasm']) {
    const bytes = readFileSync(join(STATIC, 'decode', name));
    console.log(`${name}: ${bytes.length} bytes, gzip ${gzipSync(bytes, { level: 9 }).length}`);
  }
}

/** Median of the native decoder on one thread in ms, or null if its example is not built. */
function nativeMs(file) {
  const example = join(dirname(program), 'examples/decode_loop');
  if (!existsSync(example)) return null;
  const env = { ...process.env, RAYON_NUM_THREADS: '1' };
  return Number(
    execFileSync(example, [file, String(NATIVE_ROUNDS)], { env })
      .toString()
      .match(/median ([\d.]+) ms/)?.[1],
  );
}

async function decodeTimes(address, files) {
  for (const [file, name] of files.entries()) {
    const all = await decodeRounds(address, { file, runs, rounds });
    console.log(basename(name));
    const times = (key) => all.map((round) => round[key]);
    console.log(`  ${TIMES.map((key) => `${key} ${range(times(key))}`).join(', ')}`);
    const native = nativeMs(name);
    if (native)
      console.log(
        `  native, one thread ${native.toFixed(1)} ms; warm wasm takes ${(median(times('warm')) / native).toFixed(2)} times that`,
      );
    console.log(`  memory ${Math.max(...times('memory')).toFixed(1)} MiB per megapixel`);
  }
}

async function pageThread(address, files) {
  for (const [file, name] of files.entries()) {
    for (const webgpu of [true, false]) {
      const { mode, tasks } = await pageTasks(`${address}wasm/`, `${address}file/${file}`, webgpu);
      const long = tasks.filter(({ cpuMs }) => cpuMs > FRAME_MS).length;
      console.log(`${basename(name)}, ${mode}: ${long} of ${tasks.length} tasks take over ${FRAME_MS} ms; the longest:`);
      for (const { cpuMs, ms, what } of tasks.slice(0, 3)) {
        console.log(`  ${cpuMs.toFixed(1)} ms CPU, ${(ms - cpuMs).toFixed(1)} ms waiting: ${what.join('; ')}`);
      }
    }
  }
}

async function overLink(photo) {
  const link = { mbps: Number(values.mbps), latency: Number(values.latency) };
  for (const webgpu of [true, false]) {
    const times = await firstViews(photo, { ...link, runs: rounds, webgpu });
    const column = (key) => range(times.map((time) => time[key]));
    console.log(
      `${times[0].mode}, ${link.mbps} Mb/s: photo ${column('photo')}, scene uploaded ${column('ready')}, drawn ${column('drawn')}`,
    );
  }
}

const folder = mkdtempSync(join(tmpdir(), 'tmpi-speed-'));
try {
  const containers = positionals.filter((name) => name.endsWith('.tmpi'));
  const made = [];
  for (const photo of positionals.filter((name) => !name.endsWith('.tmpi'))) made.push(...(await containersOf(photo, folder)));
  const files = [...containers, ...made.map(({ container }) => container)];
  const server = await startSpeedServer(files);
  if (parts.includes('sizes')) sizes();
  if (parts.includes('decode')) await decodeTimes(server.address, files);
  if (parts.includes('page')) await pageThread(server.address, files);
  const photo = made.find((entry) => entry.photo.includes(LINK_SIZE))?.photo;
  if (parts.includes('link') && photo) await overLink(photo);
  server.close();
} finally {
  rmSync(folder, { recursive: true, force: true });
}

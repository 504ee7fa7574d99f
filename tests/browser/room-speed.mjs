// Measures how long the page's room decoder takes for a frame of a recorded room, without drawing. Not a test; run it on an idle machine:
//   tmpi-lab live-bench --only still --files out      (or: tmpi live watch ROOM --record FILE)
//   node room-speed.mjs [--rounds 3] out/still.room…
// `frame` converts a frame's planes to RGB, which the core needs for layers in any case: 1 to 3 % of the whole (0.6 of 61 ms at the median of a
// busy machine, 320×240), so a second conversion in WGSL would gain nothing.
import { basename } from 'node:path';
import { parseArgs } from 'node:util';
import { roomTimes } from './speed/room.mjs';
import { startSpeedServer } from './speed/server.mjs';

const { values, positionals } = parseArgs({ allowPositionals: true, options: { rounds: { type: 'string', default: '3' } } });
if (!positionals.length) {
  console.error('usage: node room-speed.mjs [--rounds N] FILE…');
  process.exit(2);
}
const PARTS = ['all', 'read', 'frame', 'layers', 'cells'];
/** Frames to skip while the browser optimises the WebAssembly. */
const WARM = 30;

const at = (sorted, share) => sorted[Math.min(sorted.length - 1, Math.floor(sorted.length * share))];
const server = await startSpeedServer(positionals);
try {
  for (const [file, name] of positionals.entries()) {
    const all = [];
    let result = null;
    for (let round = 0; round < Number(values.rounds); round++) {
      result = await roomTimes(server.address, file);
      all.push(...result.times.slice(WARM));
    }
    console.log(`${basename(name)}: ${result.size.join('×')}, ${all.length} frames, memory ${(result.memory / 2 ** 20).toFixed(1)} MiB`);
    const total = (part) => all.reduce((sum, time) => sum + time[part], 0);
    for (const part of PARTS) {
      const sorted = all.map((time) => time[part]).toSorted((a, b) => a - b);
      const [p50, p95, most] = [at(sorted, 0.5), at(sorted, 0.95), sorted.at(-1)];
      console.log(
        `  ${part.padEnd(7)} p50 ${p50.toFixed(2)} ms, p95 ${p95.toFixed(2)} ms, max ${most.toFixed(2)} ms, ${((total(part) / total('all')) * 100).toFixed(1)} % of all`,
      );
    }
  }
} finally {
  server.close();
}

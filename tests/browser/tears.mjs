// Counts pictures of a room in which a fast box is torn, seen from the side: a fake camera films it, at most 4.2 pixels a frame at 320×240. Not a
// test; run it with the built program:
//   node tears.mjs [--times 1] [--count 64] [--busy 0] [--out DIR]
// `--times 2`: at 640×480. `--busy N`: beside N busy processes. `--out`: writes the pictures to look at, as PPM. A picture is torn if an edge of the
// box leaves its own line in more than 4 % of the rows.
import { spawn } from 'node:child_process';
import { mkdirSync, mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { parseArgs } from 'node:util';
import { launch, openPage, pixelsAt, waitForMode } from './support/browser.mjs';
import { startServer } from './support/program.mjs';
import { tornRows } from './support/torn.mjs';
import { HEIGHT, WIDTH, writeFilm } from './support/video.mjs';

const { values } = parseArgs({
  options: {
    times: { type: 'string', default: '1' },
    count: { type: 'string', default: '64' },
    busy: { type: 'string', default: '0' },
    out: { type: 'string' },
  },
});
const [times, count, busy] = [values.times, values.count, values.busy].map(Number);
if (!([1, 2].includes(times) && count >= 1 && busy >= 0)) {
  console.error('usage: node tears.mjs [--times 1|2] [--count PICTURES] [--busy PROCESSES] [--out DIR]');
  process.exit(2);
}
/** The camera's offset to either side, in the room's unit, and the fraction of torn rows from which a picture is torn. */
const [SIDE, TORN] = [0.05, 0.04];
const [width, height] = [WIDTH * times, HEIGHT * times];

/** Writes a picture as PPM. */
function write(name, pixels) {
  mkdirSync(values.out, { recursive: true });
  const rgb = Buffer.from(pixels.filter((_, i) => i % 4 < 3));
  writeFileSync(join(values.out, `${name}.ppm`), Buffer.concat([Buffer.from(`P6 ${width} ${height} 255\n`), rgb]));
}

const folder = mkdtempSync(join(tmpdir(), 'tmpi-tears-'));
const film = join(folder, 'film.y4m');
writeFilm(film, times);
const server = await startServer();
const more = ['--use-fake-device-for-media-stream', '--use-fake-ui-for-media-stream', `--use-file-for-fake-video-capture=${film}`];
const camera = await launch({ webgpu: false, more });
const browser = await launch();
const load = Array.from({ length: busy }, () => spawn(process.execPath, ['-e', 'for (;;);'], { stdio: 'ignore' }));
try {
  const publisher = await openPage(camera, { permissions: ['camera', 'microphone'] });
  await publisher.page.goto(`${server.url}/live/tears/publish`);
  await publisher.page.selectOption('#size', `${width}x${height}`);
  await publisher.page.locator('#go').click();
  await publisher.page.waitForFunction(() => document.body.dataset.state === 'live');
  const { page } = await openPage(browser, { viewport: { width, height } });
  await page.goto(`${server.url}/live/tears`);
  await waitForMode(page, 'gpu');
  // seconds until the server has measured its costs
  await page.waitForTimeout(4000);
  let torn = 0;
  for (let n = 0; n < count; n++) {
    // not in step with the film
    await page.waitForTimeout(137 + 61 * (n % 7));
    const pixels = await pixelsAt(page, { tx: n % 2 ? SIDE : -SIDE }, width, height);
    const rows = tornRows(pixels, width, height);
    if (rows > TORN) torn++;
    if (values.out) write(`${String(n).padStart(3, '0')}-${Math.round(100 * rows)}`, pixels);
  }
  console.log(`${torn} of ${count} pictures torn at ${width}×${height}, beside ${busy} busy processes`);
} finally {
  for (const process of load) process.kill();
  await camera.close();
  await browser.close();
  await server.close();
  rmSync(folder, { recursive: true });
}

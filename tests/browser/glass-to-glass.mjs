// Measures the time from a frame on the publisher's page to its pixels on a viewer's canvas on this machine, at 320×240 or `--times` that, shown at
// `--stage` times that. Not a test; run it on an idle machine with the built program:
//   node glass-to-glass.mjs [--times 1] [--stage 1] [--every 10] [--seconds 20] [--p50 100] [--p95 150] [--frames 30] [--json FILE]
// TMPI_WEBGPU=native draws on the machine's GPU instead of in software.
// Exits with status 1 if a limit is exceeded. Each frame of the film contains its number; the clock starts when the publisher's page takes the
// frame and stops right after the viewer's page has drawn it. Reads back one of `--every` pictures, which takes time itself, so a second run counts
// frames without reading back.
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { loadavg, tmpdir } from 'node:os';
import { join } from 'node:path';
import { parseArgs } from 'node:util';
import { launch, openPage, waitForMode } from './support/browser.mjs';
import { startServer } from './support/program.mjs';
import { FRAMES, HEIGHT, SQUARE, WIDTH, writeFilm } from './support/video.mjs';

const { values } = parseArgs({
  options: {
    times: { type: 'string', default: '1' },
    stage: { type: 'string' },
    every: { type: 'string', default: '10' },
    seconds: { type: 'string', default: '20' },
    p50: { type: 'string', default: '100' },
    p95: { type: 'string', default: '150' },
    frames: { type: 'string', default: '30' },
    json: { type: 'string' },
  },
});
const [times, every, seconds, p50, p95, frames] = ['times', 'every', 'seconds', 'p50', 'p95', 'frames'].map((name) => Number(values[name]));
const stage = Number(values.stage ?? times);
if (!([1, 2].includes(times) && stage > 0 && every >= 1 && seconds > 0 && p50 > 0 && p95 > 0 && frames >= 0)) {
  console.error(
    'usage: node glass-to-glass.mjs [--times 1|2] [--stage TIMES] [--every PICTURES] [--seconds N] [--p50 MS] [--p95 MS] [--frames A_SECOND] [--json FILE]',
  );
  process.exit(2);
}
/** Seconds before the measurement. */
const WARM = 3;
/** Length of the film in ms; longer latencies are ambiguous. */
const FILM_MS = (FRAMES * 1000) / 30;

/** On the publisher's page: records when it takes each frame number. */
function watchCamera(square) {
  window.taken = [];
  const { encode } = VideoEncoder.prototype;
  VideoEncoder.prototype.encode = function (frame, options) {
    if (window.counting) return encode.call(this, frame, options);
    const copy = frame.clone();
    const luma = new Uint8Array(copy.allocationSize());
    copy.copyTo(luma).then(([{ offset, stride }]) => {
      let number = 0;
      for (let bit = 0; bit < 6; bit++)
        number = number * 2 + Number(luma[offset + (square / 2) * stride + bit * square + square / 2] > 128);
      // the timestamp is the time of capture, µs since 1970
      window.taken.push([number, copy.timestamp / 1000]);
      copy.close();
    });
    return encode.call(this, frame, options);
  };
}

/** On the viewer's page: records when each frame number is drawn, before the browser clears the canvas. */
function watchCanvas(every) {
  window.seen = [];
  const original = window.requestAnimationFrame.bind(window);
  const context = new OffscreenCanvas(96, 16).getContext('2d', { willReadFrequently: true });
  let [last, count] = [-1, 0];
  window.requestAnimationFrame = (callback) =>
    original((time) => {
      callback(time);
      const now = performance.timeOrigin + performance.now();
      const canvas = window.viewer?.canvas;
      if (!window.measured || !canvas?.width || window.counting || count++ % every) return;
      const [across, down] = [canvas.width / 320, canvas.height / 240];
      context.drawImage(canvas, 0, 0, 96 * across, 16 * down, 0, 0, 96, 16);
      const { data } = context.getImageData(0, 0, 96, 16);
      const green = Array.from({ length: 6 }, (_, bit) => data[(8 * 96 + bit * 16 + 8) * 4 + 1]);
      // an all-black canvas was not drawn this time: the film has no black
      if (Math.max(...green) === 0) return;
      const number = green.reduce((bits, value) => bits * 2 + Number(value > 128), 0);
      // the same frame again, for a moved camera, is no new picture
      if (number !== last) window.seen.push([number, now]);
      last = number;
    });
}

const folder = mkdtempSync(join(tmpdir(), 'tmpi-glass-'));
const film = join(folder, 'film.y4m');
writeFilm(film, times);
const server = await startServer();
const fake = ['--use-fake-device-for-media-stream', '--use-fake-ui-for-media-stream', `--use-file-for-fake-video-capture=${film}`];
const camera = await launch({ webgpu: false, more: fake });
const browser = await launch();
try {
  const publisher = await openPage(camera, { permissions: ['camera', 'microphone'] });
  await publisher.page.addInitScript(watchCamera, SQUARE * times);
  await publisher.page.goto(`${server.url}/live/glass/publish`);
  await publisher.page.selectOption('#size', `${WIDTH * times}x${HEIGHT * times}`);
  await publisher.page.locator('#go').click();
  await publisher.page.waitForFunction(() => document.body.dataset.state === 'live');
  const { page } = await openPage(browser, { viewport: { width: WIDTH * stage, height: HEIGHT * stage } });
  await page.addInitScript(watchCanvas, every);
  await page.goto(`${server.url}/live/glass`);
  await page.addStyleTag({ content: `#stage { position: fixed; inset: 0; width: ${WIDTH * stage}px; height: ${HEIGHT * stage}px; }` });
  await waitForMode(page, 'gpu');
  await page.waitForTimeout(WARM * 1000);
  for (const opened of [publisher, { page }]) await opened.page.evaluate(() => (window.taken ?? window.seen).splice(0));
  const watch = async () => {
    const rates = [];
    for (let i = 0; i < seconds * 2; i++) {
      await page.waitForTimeout(500);
      rates.push(await page.evaluate(() => window.measured));
    }
    return rates;
  };
  const withReads = await watch();
  const seen = await page.evaluate(() => window.seen);
  const taken = await publisher.page.evaluate(() => window.taken);
  for (const opened of [publisher, { page }]) {
    await opened.page.evaluate(() => {
      window.counting = true;
    });
  }
  const counted = await watch();
  const latencies = [];
  for (const [number, at] of seen) {
    // the film repeats, so take the last frame with this number
    const frame = taken.findLast(([n, when]) => n === number && when <= at);
    if (frame && at - frame[1] < FILM_MS) latencies.push(at - frame[1]);
  }
  if (process.env.TMPI_SHOTS) await page.screenshot({ path: join(process.env.TMPI_SHOTS, 'glass.png') });
  const sorted = latencies.toSorted((a, b) => a - b);
  const percentile = (p) => sorted[Math.min(sorted.length - 1, Math.floor(sorted.length * p))] ?? Number.NaN;
  const mean = (list) => list.reduce((sum, { frames }) => sum + frames, 0) / list.length;
  // frames per second that the room sent, by frame numbers
  const sent = (list) => ((list.at(-1).frame - list[0].frame) / (list.length - 1)) * 2;
  const last = withReads.at(-1);
  const result = {
    p50: percentile(0.5),
    p95: percentile(0.95),
    frames: mean(counted),
    framesRead: mean(withReads),
    sent: sent(counted),
    samples: latencies.length,
    unknown: seen.length - latencies.length,
    told: last.latency,
    buffer: last.buffer,
    geometryMs: last.geometryMs,
    load: loadavg()[0],
  };
  console.log(
    `p50 ${result.p50.toFixed(1)} ms, p95 ${result.p95.toFixed(1)} ms, ${result.frames.toFixed(1)} of ${result.sent.toFixed(1)} frames/s, ${result.framesRead.toFixed(1)} while read back (${result.samples} pictures, ${result.unknown} with an unknown number; ` +
      `the page reports ${result.told.toFixed(0)} ms, buffers ${(result.buffer ?? 0).toFixed(0)} ms, tiles after ${result.geometryMs.toFixed(0)} ms; load ${result.load.toFixed(1)})`,
  );
  if (values.json) writeFileSync(values.json, `${JSON.stringify(result, null, 1)}\n`);
  // too few pictures make the percentiles meaningless
  const enough = result.samples >= seconds && result.unknown <= result.samples / 10;
  if (!enough) console.error('too few readable pictures');
  if (!enough || !(result.p50 <= p50 && result.p95 <= p95 && result.frames >= frames)) process.exitCode = 1;
} finally {
  await camera.close();
  await browser.close();
  await server.close();
  rmSync(folder, { recursive: true, force: true });
}

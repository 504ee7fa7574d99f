// Shared setup for tests of rooms: a server, a browser with a fake camera, and one for viewers.
import { mkdtempSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before } from 'node:test';
import { evaluateBytes, launch, launchCamera, openPage, pixelsAt, ROOM } from './browser.mjs';
import { startServer } from './program.mjs';
import { FRAMES, frameNumber, HEIGHT, psnr, rgba, WIDTH } from './video.mjs';

/** PSNR in dB from which a picture equals its source except for compression. */
export const SAME_DB = 32;

/** Call it in `describe`. `args` returns further server arguments, given a temporary folder. */
export function roomSuite(args = () => []) {
  const suite = {
    server: null,
    camera: null,
    browser: null,
    folder: mkdtempSync(join(tmpdir(), 'tmpi-room-')),
    /** Publishes in a room from its page; `prepare` runs before the page loads, `loaded` before it publishes. */
    async publish(room, { hash = '', options = {}, prepare = async () => {}, loaded = async () => {} } = {}) {
      const opened = await openPage(suite.camera, { ...ROOM, permissions: ['camera', 'microphone'], ...options });
      await prepare(opened.page);
      await opened.page.goto(`${suite.server.url}/live/${room}/publish${hash}`);
      await loaded(opened.page);
      await opened.page.selectOption('#size', `${WIDTH}x${HEIGHT}`);
      await opened.page.locator('#go').click();
      await opened.page.waitForFunction(() => document.body.dataset.state === 'live');
      return opened;
    },
    /** Opens the viewer's page. */
    async watch(room, { hash = '', options = {}, prepare = async () => {} } = {}) {
      const opened = await openPage(suite.browser, { ...ROOM, ...options });
      await prepare(opened.page);
      await opened.page.goto(`${suite.server.url}/live/${room}${hash}`);
      return opened;
    },
  };
  before(async () => {
    suite.server = await startServer(args(suite.folder));
    suite.camera = await launchCamera(suite.folder);
    suite.browser = await launch();
  });
  after(async () => {
    await suite.camera?.close();
    await suite.browser?.close();
    await suite.server?.close();
    rmSync(suite.folder, { recursive: true, force: true });
  });
  return suite;
}

/** The picture from the reference camera: its frame number, and its PSNR in dB to that frame and to one half a film away. */
export async function shownFrame(page) {
  return compareWithFilm(await pixelsAt(page, {}, WIDTH, HEIGHT));
}

/** Compares pixels with the film: frame number, and PSNR in dB to that frame and to one half a film away. */
export function compareWithFilm(pixels) {
  const number = frameNumber(pixels);
  return { pixels, number, same: psnr(pixels, rgba(number % FRAMES)), other: psnr(pixels, rgba((number + FRAMES / 2) % FRAMES)) };
}

/** Pixels of the flat video. */
export function flatPixels(page) {
  const script = async ([w, h]) => window.viewer.canvas.getContext('2d').getImageData(0, 0, w, h).data;
  return evaluateBytes(page, script, [WIDTH, HEIGHT]);
}

/** Waits until the page has shown `count` more frames. */
export async function waitForFrames(page, count) {
  const { frame } = await (await page.waitForFunction(() => window.measured)).jsonValue();
  await page.waitForFunction(([before, n]) => window.measured.frame >= before + n, [frame, count]);
}

/** Saves a screenshot in the folder in TMPI_SHOTS, if set. */
export async function saveScreenshot(page, name) {
  if (process.env.TMPI_SHOTS) await page.screenshot({ path: join(process.env.TMPI_SHOTS, `${name}.png`) });
}

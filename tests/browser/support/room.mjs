// What suites of rooms need: a server, a browser with a fake camera, one that watches, and pages in them.
import { mkdtempSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before } from 'node:test';
import { launch, openPage, pixelsAt, samplesOf } from './browser.mjs';
import { startServer } from './program.mjs';
import { FRAMES, HEIGHT, numberOf, psnr, rgba, WIDTH, writeFilm } from './video.mjs';

/** Likeness to the source at which the picture is the same but for its coding, dB. */
export const SAME_DB = 32;
/** The least motion. */
export const STILL = { reducedMotion: 'reduce' };

/** To be called in `describe`. `args` gives further arguments of the server for a folder that goes in the end. */
export function roomSuite(args = () => []) {
  const suite = {
    server: null,
    camera: null,
    browser: null,
    folder: mkdtempSync(join(tmpdir(), 'tmpi-room-')),
    /** Publishes in a room by its page; `prepare` is done to it first. */
    async publish(room, { hash = '', options = {}, prepare = async () => {} } = {}) {
      const opened = await openPage(suite.camera, { permissions: ['camera', 'microphone'], ...options });
      await prepare(opened.page);
      await opened.page.goto(`${suite.server.url}/live/${room}/publish${hash}`);
      await opened.page.selectOption('#size', `${WIDTH}x${HEIGHT}`);
      await opened.page.locator('#go').click();
      await opened.page.waitForFunction(() => document.body.dataset.state === 'live');
      return opened;
    },
    /** Opens the page of who watches. */
    async watch(room, { hash = '', options = STILL, prepare = async () => {} } = {}) {
      const opened = await openPage(suite.browser, options);
      await prepare(opened.page);
      await opened.page.goto(`${suite.server.url}/live/${room}${hash}`);
      return opened;
    },
  };
  before(async () => {
    const film = join(suite.folder, 'film.y4m');
    writeFilm(film);
    suite.server = await startServer(args(suite.folder));
    const fake = ['--use-fake-device-for-media-stream', '--use-fake-ui-for-media-stream', `--use-file-for-fake-video-capture=${film}`];
    // one of its own, whose camera plays the film
    suite.camera = await launch({ webgpu: false, more: fake });
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

/** What is shown from the camera's own place, which frame of the film it is, and how like it is to that one and to another, dB. */
export async function shown(page) {
  return likenessOf(await pixelsAt(page, {}, WIDTH, HEIGHT));
}

/** The same of pixels. */
export function likenessOf(pixels) {
  const number = numberOf(pixels);
  return { pixels, number, same: psnr(pixels, rgba(number % FRAMES)), other: psnr(pixels, rgba((number + FRAMES / 2) % FRAMES)) };
}

/** Pixels of plain video. */
export function flatPixels(page) {
  const script = async ([w, h]) => window.viewer.canvas.getContext('2d').getImageData(0, 0, w, h).data;
  return samplesOf(page, script, [WIDTH, HEIGHT]);
}

/** Waits until the page has shown so many more frames of the video. */
export async function showsFrames(page, count) {
  const { frame } = await (await page.waitForFunction(() => window.measured)).jsonValue();
  await page.waitForFunction(([before, n]) => window.measured.frame >= before + n, [frame, count]);
}

/** A screenshot, where TMPI_SHOTS names a folder for them. */
export async function shoot(page, name) {
  if (process.env.TMPI_SHOTS) await page.screenshot({ path: join(process.env.TMPI_SHOTS, `${name}.png`) });
}

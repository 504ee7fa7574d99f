// From a fake camera to the moving picture, on the built program: one page publishes, another watches.
import assert from 'node:assert/strict';
import { mkdtempSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { launch, openPage, pixelsAt, seriousViolations, shareDifferent, waitForMode } from '../support/browser.mjs';
import { startServer } from '../support/program.mjs';
import { FRAMES, HEIGHT, numberOf, psnr, rgba, WIDTH, writeFilm } from '../support/video.mjs';

/** Likeness to the source at which the picture is the same but for its coding, dB. */
const SAME_DB = 32;
/** Where screenshots are put, if anywhere. */
const SHOTS = process.env.TMPI_SHOTS;

describe('a room', () => {
  let server;
  let camera;
  let browser;
  const folder = mkdtempSync(join(tmpdir(), 'tmpi-film-'));

  before(async () => {
    const film = join(folder, 'film.y4m');
    writeFilm(film);
    server = await startServer();
    const fake = ['--use-fake-device-for-media-stream', '--use-fake-ui-for-media-stream', `--use-file-for-fake-video-capture=${film}`];
    camera = await launch({ webgpu: false, more: fake });
    browser = await launch({ more: ['--autoplay-policy=no-user-gesture-required'] });
  });
  after(async () => {
    await camera?.close();
    await browser?.close();
    await server?.close();
    rmSync(folder, { recursive: true, force: true });
  });

  /** Publishes in a room by the page; gives the page. */
  async function publish(room, options, prepare = async () => {}) {
    const opened = await openPage(camera, options);
    await prepare(opened.page);
    await opened.page.goto(`${server.url}/live/${room}/publish`);
    await opened.page.selectOption('#size', `${WIDTH}x${HEIGHT}`);
    await opened.page.getByRole('button', { name: 'Start' }).click();
    await opened.page.waitForFunction(() => document.body.dataset.state === 'live');
    return opened;
  }

  const shoot = async (page, name) => SHOTS && page.screenshot({ path: join(SHOTS, `${name}.png`) });

  /** What is shown from the camera's own place, and which frame of the film it is. */
  async function shown(page) {
    const pixels = await pixelsAt(page, {}, WIDTH, HEIGHT);
    return { pixels, number: numberOf(pixels) };
  }

  test('what a camera sees is what others see, and they look around in it', async (t) => {
    const publisher = await publish('attic', { permissions: ['camera', 'microphone'] });
    const { page, context, errors } = await openPage(browser, { reducedMotion: 'reduce' });
    const began = performance.now();
    await page.goto(`${server.url}/live/attic`);
    await waitForMode(page, 'gpu');
    t.diagnostic(`page to first 3D frame: ${(performance.now() - began).toFixed(0)} ms`);
    const seen = new Set();
    const likeness = [];
    for (let i = 0; i < 8; i++) {
      await page.waitForTimeout(150);
      const { pixels, number } = await shown(page);
      assert.ok(number < FRAMES, `${number}`);
      seen.add(number);
      const best = Math.max(...[-1, 0, 1].map((d) => psnr(pixels, rgba((number + d + FRAMES) % FRAMES))));
      const other = psnr(pixels, rgba((number + FRAMES / 2) % FRAMES));
      assert.ok(best > other + 3, `frame ${number}: ${best} dB, half a turn away ${other} dB`);
      likeness.push(best);
    }
    t.diagnostic(`likeness to the source: ${likeness.map((v) => v.toFixed(1)).join(', ')} dB`);
    assert.ok(Math.min(...likeness) > SAME_DB, `${likeness}`);
    assert.ok(seen.size > 3, `frames seen: ${[...seen]}`);
    await shoot(page, 'watch-home');
    const home = await shown(page);
    const moved = await pixelsAt(page, { tx: 0.05, yaw: -1 }, WIDTH, HEIGHT);
    assert.ok(shareDifferent(home.pixels, moved, WIDTH, HEIGHT) > 0.1, 'a moved camera sees something else');
    // nothing is torn open
    const empty = moved.filter((_, i) => i % 4 === 3).filter((a) => a < 250).length / (WIDTH * HEIGHT);
    assert.ok(empty < 0.03, `${empty} of the moved picture is empty`);
    await page.waitForTimeout(500);
    await shoot(page, 'watch-moved');
    await page.getByRole('button', { name: 'Sound' }).click();
    await page.waitForFunction(() => {
      window.loudest = Math.max(window.loudest ?? 0, window.sound.level);
      return window.sound.played > 1 && window.loudest > 0.01;
    });
    await page.waitForTimeout(3000);
    const told = await page.evaluate(() => window.measured);
    t.diagnostic(
      `made in ${told.madeMs.toFixed(1)} ms, video ${told.videoMs.toFixed(1)} ms, behind ${told.latency.toFixed(0)} ms, ` +
        `${told.frames.toFixed(0)} frames/s, ${told.kbits.toFixed(0)} kbit/s, tiles after ${told.geometryMs.toFixed(0)} ms`,
    );
    assert.match(await page.locator('#readout').textContent(), /\d+ ms · \d+ frames\/s · \d+ kbit\/s/);
    assert.deepEqual(await seriousViolations(page), []);
    await publisher.page.waitForFunction(() => /1 watching/.test(document.getElementById('state').textContent));
    await shoot(publisher.page, 'publish-live');
    const link = await publisher.page.locator('#link').inputValue();
    assert.equal(link, `${server.url}/live/attic`);
    assert.match(await publisher.page.evaluate(() => window.publisher.codec), /avc1|vp09|jpeg/);
    t.diagnostic(`codec ${await publisher.page.evaluate(() => window.publisher.codec)}`);
    assert.deepEqual(await seriousViolations(publisher.page), []);
    await publisher.page.getByRole('button', { name: 'Stop' }).click();
    await publisher.page.getByText('You are not live any more.').waitFor();
    await page.waitForFunction(() => ['ended', 'stalled'].includes(document.body.dataset.state));
    // the same camera anew
    await publisher.page.getByRole('button', { name: 'Start' }).click();
    await page.waitForFunction(() => document.body.dataset.state === 'live');
    assert.deepEqual([...errors, ...publisher.errors], []);
    await context.close();
    await publisher.context.close();
  });
});

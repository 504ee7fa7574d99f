// The built program from upload to the moving picture.
import assert from 'node:assert/strict';
import { existsSync, readFileSync } from 'node:fs';
import { join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import {
  disableGraphics,
  downloadBytes,
  filePixels,
  fractionDifferent,
  launch,
  MOTION,
  openPage,
  pixelsAt,
  seriousViolations,
  waitForMode,
} from '../support/browser.mjs';
import { BOX, boxDepth, boxPhoto } from '../support/pictures.mjs';
import { makePhoto, startServer } from '../support/program.mjs';
import { skip } from '../support/skip.mjs';
import { waitForAnimationFrames } from '../support/until.mjs';

const WIDTH = 320;
const HEIGHT = 200;
/** Fraction of pixels that may differ by more than 8 levels between browser and server. */
const MAX_SHARE = 0.015;
const POSES = [
  { tx: 0.025, ty: -0.01, tz: 0.01 },
  { tx: -0.02, ty: 0.015, tz: -0.02, yaw: 1.5, pitch: -1, roll: 2 },
];
const realPhoto = join(process.env.TMPI_DATA || '.', 'photos/dav2/demo01.jpg');

const query = (pose, width, height) => new URLSearchParams({ ...pose, w: width, h: height, format: 'png' });

/** Compares the canvas with the server's view at both poses; returns the fractions of different pixels. */
async function compare(page, id, width, height) {
  const shares = [];
  for (const pose of POSES) {
    const drawn = await pixelsAt(page, pose, width, height);
    const served = await filePixels(page, `/v1/photos/${id}/view?${query(pose, width, height)}`);
    shares.push(fractionDifferent(drawn, served, width, height));
  }
  return shares;
}

describe('the whole program', () => {
  let server;
  let browser;
  let made;
  before(async () => {
    server = await startServer();
    browser = await launch();
    made = await makePhoto(server.url, boxPhoto(WIDTH, HEIGHT), boxDepth(WIDTH, HEIGHT));
  });
  after(async () => {
    await browser?.close();
    await server?.close();
  });

  test('uploads, shows, downloads and deletes a photo', async () => {
    const { page, context, errors } = await openPage(browser, MOTION);
    await page.addInitScript(() => {
      window.stagesShown = [];
      new MutationObserver(() => {
        const text = document.querySelector('.upload-state')?.textContent;
        if (text && window.stagesShown.at(-1) !== text) window.stagesShown.push(text);
      }).observe(document, { childList: true, subtree: true, characterData: true });
    });
    await page.goto(server.url);
    await page.setInputFiles('#picker', { name: 'garden.png', mimeType: 'image/png', buffer: boxPhoto(720, 468) });
    const open = page.getByRole('link', { name: 'Open garden.png' });
    await open.waitFor();
    const stages = await page.evaluate(() => window.stagesShown);
    // the page may miss some stages
    const seen = [/depth/i, /planes/i, /layers/i, /Packing|Checking/].filter((word) => stages.some((s) => word.test(s)));
    assert.ok(seen.length >= 2, `${stages}`);
    const inGallery = page.locator('#gallery .card').filter({ hasText: 'garden' });
    await inGallery.waitFor();
    await page.waitForFunction(() => document.querySelector('#gallery img.thumb')?.naturalWidth > 0);
    await open.click();
    await waitForMode(page, 'gpu');
    assert.equal(await page.locator('#title').textContent(), 'garden');
    const first = await page.evaluate(() => window.viewer.pose.tx);
    await page.waitForFunction((tx) => Math.abs(window.viewer.pose.tx - tx) > 1e-3, first);
    await page.emulateMedia({ reducedMotion: 'reduce' });
    // the frame time appears after the first measurement
    await page.waitForFunction(() => /\d kB · [\d.]+ ms/.test(document.getElementById('facts').textContent));
    const [download] = await Promise.all([
      page.waitForEvent('download'),
      page
        .getByRole('button', { name: 'Download' })
        .click()
        .then(() => page.locator('#download').click()),
    ]);
    assert.equal(download.suggestedFilename(), 'garden.tmpi');
    assert.equal((await downloadBytes(download)).toString('latin1', 0, 4), 'TMPI');
    for (const [format, start] of [
      ['html', '<!doctype html>'],
      ['glb', 'glTF'],
      ['ora', 'PK'],
    ]) {
      const [file] = await Promise.all([
        page.waitForEvent('download'),
        page.locator(`[data-export=${format}]`).evaluate((link) => link.click()),
      ]);
      assert.match(file.suggestedFilename(), new RegExp(`\\.${format}$`));
      assert.equal((await downloadBytes(file)).toString('latin1', 0, start.length).toLowerCase(), start.toLowerCase());
    }
    await page.goto(server.url);
    await page.getByRole('button', { name: 'Delete garden' }).click();
    await inGallery.waitFor({ state: 'detached' });
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('draws the same as the server; only the box moves', async (t) => {
    const { page, context } = await openPage(browser);
    await page.goto(`${server.url}/view/${made.id}`);
    await waitForMode(page, 'gpu');
    const home = await pixelsAt(page, {}, WIDTH, HEIGHT);
    for (const pose of POSES) {
      const moved = fractionDifferent(home, await pixelsAt(page, pose, WIDTH, HEIGHT), WIDTH, HEIGHT);
      assert.ok(moved > 10 * MAX_SHARE, `the comparison must detect a camera that does not move: ${moved}`);
    }
    const shares = await compare(page, made.id, WIDTH, HEIGHT);
    t.diagnostic(`share off by more than 8 levels: ${shares.map((s) => s.toFixed(5)).join(', ')}`);
    for (const share of shares) assert.ok(share < MAX_SHARE, `${share}`);
    const [left, right] = [await pixelsAt(page, { tx: -0.02 }, WIDTH, HEIGHT), await pixelsAt(page, { tx: 0.02 }, WIDTH, HEIGHT)];
    const near = { x0: BOX.x0 + 0.03, x1: BOX.x1 - 0.03, y0: BOX.y0 + 0.03, y1: BOX.y1 - 0.03 };
    const far = { x0: 0.03, x1: 0.25, y0: 0.05, y1: 0.95 };
    // the box moves by 6.7 pixels, the wall by 0.7, which changes it by up to 8 levels per pixel
    const moved = fractionDifferent(left, right, WIDTH, HEIGHT, { ...near, levels: 10 });
    const stood = fractionDifferent(left, right, WIDTH, HEIGHT, { ...far, levels: 10 });
    assert.ok(moved > 0.5, `near: ${moved}`);
    assert.ok(stood < 0.05, `far: ${stood}`);
    await context.close();
  });

  test('a real photo looks the same in browser and server', async (t) => {
    if (!existsSync(realPhoto)) return skip(t, 'data', 'TMPI_DATA has no photos');
    // the page loads all of the photo's pixels only for a large screen
    const { page, context, errors } = await openPage(browser, { viewport: { width: 1280, height: 800 } });
    const state = await makePhoto(server.url, readFileSync(realPhoto));
    await page.goto(`${server.url}/view/${state.id}`);
    await waitForMode(page, 'gpu');
    const [width, height] = [480, Math.round((480 * state.height) / state.width)];
    const shares = await compare(page, state.id, width, height);
    t.diagnostic(`share off by more than 8 levels: ${shares.map((s) => s.toFixed(5)).join(', ')}`);
    for (const share of shares) assert.ok(share < MAX_SHARE, `${share}`);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('WebGL draws the same as the server', async (t) => {
    const { page, context, errors } = await openPage(browser);
    await disableGraphics(page, { webgl: true });
    await page.goto(`${server.url}/view/${made.id}`);
    await waitForMode(page, 'webgl');
    const shares = await compare(page, made.id, WIDTH, HEIGHT);
    t.diagnostic(`share off by more than 8 levels: ${shares.map((s) => s.toFixed(5)).join(', ')}`);
    for (const share of shares) assert.ok(share < MAX_SHARE, `${share}`);
    const before = await page.locator('.tmpi-canvas').screenshot();
    await page.evaluate(() => window.viewer.setPose({ tx: 0.025 }));
    assert.notDeepEqual(await page.locator('.tmpi-canvas').screenshot(), before, 'the canvas on the page changes');
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('without WebGPU and WebGL the page shows server views', async () => {
    const { page, context, errors } = await openPage(browser);
    await disableGraphics(page, { webgl: false });
    await page.goto(`${server.url}/view/${made.id}`);
    await waitForMode(page, 'served');
    await page.waitForFunction(() => window.viewer.serverViews.shown);
    await page.locator('#stage').focus();
    for (let i = 0; i < 4; i++) await page.keyboard.press('ArrowRight');
    // four steps to the right; earlier ones may be shown first
    await page.waitForFunction(() => /tx=0\.0[1-5]/.test(window.viewer.serverViews.shown));
    await page.waitForFunction(() => document.querySelector('.tmpi-poster').naturalWidth > 0);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('the demo page shows three elements, one from another origin', async () => {
    const { page, context, errors } = await openPage(browser);
    await page.goto(`${server.url}/demo`);
    for (const i of [0, 1, 2]) {
      await page.evaluate((n) => document.querySelectorAll('tmpi-viewer')[n].scrollIntoView(), i);
      await page.waitForFunction((n) => document.querySelectorAll('tmpi-viewer')[n].viewer?.mode === 'gpu', i);
    }
    const origin = await page.evaluate(
      () => new URL(document.querySelectorAll('tmpi-viewer')[2].getAttribute('src'), location.href).origin,
    );
    assert.notEqual(origin, new URL(server.url).origin);
    assert.deepEqual(await seriousViolations(page), []);
    const blob = await page.evaluate(async () => (await document.querySelector('tmpi-viewer').toBlob()).type);
    assert.equal(blob, 'image/png');
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('the owner’s settings are saved with the photo', async () => {
    const { page, context, errors } = await openPage(browser);
    const other = await makePhoto(server.url, boxPhoto(240, 150), boxDepth(240, 150));
    await page.goto(`${server.url}/view/${other.id}`);
    await waitForMode(page, 'gpu');
    const { placed, most, box } = await page.evaluate(() => {
      window.viewer.moveTo({ x: 0.8, y: 0, z: 0 });
      return { placed: window.viewer.pose.tx, most: window.viewer.limits.x, box: window.viewer.head.viewBox.x };
    });
    assert.ok(Math.abs(placed - 0.8 * most) < 1e-4 && most <= box / 2 + 1e-9 && most > 0.02, `${placed} of ${most} of ${box}`);
    await page.locator('#settings').click();
    await page.getByLabel('Title').fill('A box');
    for (const name of ['Begin with this view', 'Show this view in the list']) await page.getByRole('button', { name }).click();
    await page.getByRole('button', { name: 'Save with the photo' }).click();
    await page.getByText('Saved', { exact: true }).waitFor();
    await page.reload();
    await waitForMode(page, 'gpu');
    assert.equal(await page.locator('#title').textContent(), 'A box');
    await page.waitForFunction((tx) => Math.abs(window.viewer.pose.tx - tx) < 1e-3, placed);
    await page.goto(server.url);
    const picture = page.locator('.card').filter({ hasText: 'A box' }).locator('img');
    await page.waitForFunction(() =>
      [...document.querySelectorAll('.card img')].some((image) => image.src.includes('/view?tx=') && image.naturalWidth > 0),
    );
    const [, shown] = (await picture.getAttribute('src')).match(/\/view\?tx=([\d.]+)/);
    assert.ok(Math.abs(Number(shown) - placed) < 1e-3, shown);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('rejects other files with a reason', async () => {
    const { page, context } = await openPage(browser);
    await page.goto(server.url);
    await page.setInputFiles('#picker', { name: 'notes.png', mimeType: 'image/png', buffer: Buffer.from('this is no picture at all') });
    const row = page.locator('.upload.failed');
    await row.waitFor();
    const reason = await row.locator('.upload-state').textContent();
    assert.match(reason, /JPEG|PNG|WebP|format|picture/i);
    await row.getByRole('button', { name: 'Dismiss notes.png' }).click();
    await row.waitFor({ state: 'detached' });
    await context.close();
  });

  test('pages fit a phone', async () => {
    const { page, context } = await openPage(browser, { viewport: { width: 390, height: 844 }, hasTouch: true });
    for (const path of ['/', `/view/${made.id}`]) {
      await page.goto(server.url + path);
      if (path === '/') await page.locator('#gallery .card').first().waitFor();
      else await waitForMode(page, 'gpu');
      for (const width of [390, 360]) {
        await page.setViewportSize({ width, height: 844 });
        await waitForAnimationFrames(page, 2);
        const [wide, inner] = await page.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
        assert.ok(wide <= inner, `${path} is ${wide} pixels wide on ${inner}`);
        const cut = await page.evaluate(() =>
          [...document.querySelectorAll('button, a, label')]
            .map((e) => [e.textContent.trim(), e.getBoundingClientRect()])
            .filter(([, r]) => r.width > 0 && (r.left < 0 || r.right > innerWidth + 0.5))
            .map(([text]) => text),
        );
        assert.deepEqual(cut, []);
      }
    }
    await context.close();
  });
});

// Exports, opened by other programs.
import assert from 'node:assert/strict';
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { pathToFileURL } from 'node:url';
import { filePixels, fractionDifferent, launch, MOTION, openPage, pixelsAt, VIEWPORT, waitForMode } from '../support/browser.mjs';
import { openModel, validate } from '../support/gltf.mjs';
import { boxPhoto, inBox, png16 } from '../support/pictures.mjs';
import { makePhoto, startServer } from '../support/program.mjs';

const WIDTH = 320;
const HEIGHT = 200;
const MAX_SHARE = 0.015;
/** For lossy WebP textures, which change this sharp texture by 2.1 to 2.4 %. */
const MAX_SHARE_LOSSY = 0.03;
/** Comparisons exclude borders, because renderers differ beyond the photo. */
const INNER = { x0: 0.05, y0: 0.05, x1: 0.95, y1: 0.95 };
const POSES = [
  { tx: 0.025, ty: -0.01, tz: 0.01 },
  { tx: -0.02, ty: 0.015, tz: -0.02, yaw: 1.5, pitch: -1, roll: 2 },
];

/** A box on an approaching ground, below a sky. */
const depth = () => png16(WIDTH, HEIGHT, (x, y) => (inBox(x, y, WIDTH, HEIGHT) ? 0.95 : Math.max(0, y - 60) / 160));

describe('exports', () => {
  let server;
  let browser;
  let made;
  let folder;
  /** A page that decodes pictures. */
  let reader;
  const files = {};
  before(async () => {
    server = await startServer();
    browser = await launch();
    folder = mkdtempSync(join(tmpdir(), 'tmpi-export-'));
    made = await makePhoto(server.url, boxPhoto(WIDTH, HEIGHT), depth());
    for (const format of ['html', 'glb', 'ora', 'zip', 'glb&shape=metric', 'glb&textures=webp']) {
      const response = await fetch(`${server.url}${made.links.export}?format=${format}`);
      assert.equal(response.status, 200);
      assert.equal(response.headers.get('content-disposition'), `attachment; filename="${made.id}.${format.split('&')[0]}"`);
      files[format] = Buffer.from(await response.arrayBuffer());
    }
    writeFileSync(join(folder, 'photo.html'), files.html);
    ({ page: reader } = await openPage(browser));
    await reader.goto(server.url);
  });
  after(async () => {
    await browser?.close();
    await server?.close();
    if (folder) rmSync(folder, { recursive: true, force: true });
  });

  /** Opens the page from disk; `requests` collects every external URL. */
  async function openPageFile(on, options) {
    const opened = await openPage(on, options);
    const requests = [];
    opened.page.on('request', (request) => /^(data|blob|file):/.test(request.url()) || requests.push(request.url()));
    await opened.page.goto(pathToFileURL(join(folder, 'photo.html')).href);
    return { ...opened, requests };
  }

  /** The server's view at a pose. */
  function served(pose) {
    const query = new URLSearchParams({ ...pose, w: WIDTH, h: HEIGHT, format: 'png' });
    return filePixels(reader, `/v1/photos/${made.id}/view?${query}`);
  }

  const screenshot = async (page) => filePixels(reader, await page.screenshot());

  test('the page works from disk without requests', async (t) => {
    const { page, context, errors, requests } = await openPageFile(browser, MOTION);
    await waitForMode(page, 'gpu');
    const first = await page.evaluate(() => window.viewer.pose.tx);
    await page.waitForFunction((tx) => Math.abs(window.viewer.pose.tx - tx) > 2e-3, first);
    await page.emulateMedia({ reducedMotion: 'reduce' });
    const shares = [];
    for (const pose of POSES) shares.push(fractionDifferent(await pixelsAt(page, pose, WIDTH, HEIGHT), await served(pose), WIDTH, HEIGHT));
    t.diagnostic(`share off by more than 8 levels: ${shares.map((s) => s.toFixed(5)).join(', ')}`);
    for (const share of shares) assert.ok(share < MAX_SHARE, `${share}`);
    // the change is visible on the screen
    await page.evaluate(() => window.viewer.setPose({ tx: -0.03 }));
    const left = await screenshot(page);
    await page.evaluate(() => window.viewer.setPose({ tx: 0.03 }));
    const right = await screenshot(page);
    assert.ok(fractionDifferent(left, right, VIEWPORT.width, VIEWPORT.height) > 0.05, 'the canvas does not change');
    assert.deepEqual([errors, requests], [[], []]);
    await context.close();
  });

  test('the page shows the photo without WebGPU or scripts', async (t) => {
    const plain = await launch({ webgpu: false });
    const { width, height } = VIEWPORT;
    // the photo fits into the window as a whole
    const scale = Math.min(width / WIDTH, height / HEIGHT);
    assert.deepEqual([WIDTH * scale, HEIGHT * scale], [width, height], 'the window has its shape');
    const photo = await filePixels(reader, boxPhoto(WIDTH, HEIGHT), VIEWPORT);
    const pages = [await openPageFile(plain), await openPageFile(plain, { javaScriptEnabled: false })];
    await pages[0].page.waitForFunction(() => document.getElementById('stage').dataset.mode);
    for (const { page, errors, requests } of pages) {
      // a note covers the lower border; the photo is a JPEG, enlarged by the browser
      const share = fractionDifferent(await screenshot(page), photo, width, height, { levels: 16, y1: 0.85 });
      t.diagnostic(`share off by more than 16 levels: ${share.toFixed(4)}`);
      assert.ok(share < MAX_SHARE, `${share}`);
      assert.deepEqual([errors, requests], [[], []]);
    }
    await plain.close();
  });

  for (const format of ['glb', 'glb&shape=metric', 'glb&textures=webp']) {
    const [lossy, relief] = [format.includes('webp'), !format.includes('metric')];
    test(`the ${format} model is valid and renders the same views`, async (t) => {
      const report = await validate(files[format]);
      assert.deepEqual([report.errors, report.warnings], [0, 0], JSON.stringify(report.messages));
      const { extensionsRequired = [] } = JSON.parse(files[format].subarray(20, 20 + files[format].readUInt32LE(12)).toString());
      assert.deepEqual(extensionsRequired, lossy ? ['EXT_texture_webp'] : [], 'only lossy textures need an extension');
      const { page, context, errors } = await openPage(browser);
      const model = await openModel(page, files[format]);
      for (const name of ['photo', 'opaque_0', 'soft_0', 'camera']) assert.ok(model.names.includes(name), `${name}: ${model.names}`);
      const still = await model.draw({}, WIDTH, HEIGHT);
      const shares = [];
      // a relief reproduces views only for cameras that move sideways
      const poses = relief ? POSES.map(({ tx, ty }) => ({ tx, ty })) : POSES;
      for (const pose of [{}, ...poses]) {
        const want = await served(pose);
        shares.push(fractionDifferent(await model.draw(pose, WIDTH, HEIGHT), want, WIDTH, HEIGHT, INNER));
        if (pose.tx)
          assert.ok(
            fractionDifferent(still, want, WIDTH, HEIGHT, INNER) > 3 * MAX_SHARE,
            'the comparison must detect a model that does not move',
          );
      }
      t.diagnostic(`share off by more than 8 levels: ${shares.map((s) => s.toFixed(5)).join(', ')}`);
      const most = lossy ? MAX_SHARE_LOSSY : MAX_SHARE;
      for (const share of shares) assert.ok(share < most, `${share}`);
      assert.deepEqual(errors, []);
      await context.close();
    });
  }

  test('the model fills a viewer’s frame without holes', async (t) => {
    const { page, context } = await openPage(browser);
    const model = await openModel(page, files.glb);
    const [w, h] = [640, 480];
    for (const above of [0, 15]) {
      const { size, pixels } = await model.frame(above, w, h);
      if (process.env.TMPI_PICTURES) {
        await page.evaluate(() => document.querySelector('canvas').scrollIntoView());
        await page.locator('canvas').screenshot({ path: join(process.env.TMPI_PICTURES, `framed-${above}.png`) });
      }
      assert.ok(size[2] < 0.4 * size[0] && size[0] < 1.3, `too deep, or too wide: ${size}`);
      let [covered, holes] = [0, 0];
      for (let y = 0; y < h; y++) {
        const row = Array.from({ length: w }, (_, x) => pixels[(y * w + x) * 4 + 3] > 200);
        const [first, last] = [row.indexOf(true), row.lastIndexOf(true)];
        const inside = first < 0 ? [] : row.slice(first, last + 1);
        covered += inside.length;
        holes += inside.filter((seen) => !seen).length;
      }
      // area of a flat picture with the photo's shape whose bounding sphere just fits the frame, 28 % of it here
      const flat = ((h * Math.cos(Math.PI / 12)) / 1.05 / Math.hypot(WIDTH, HEIGHT)) ** 2 * WIDTH * HEIGHT;
      t.diagnostic(
        `${above}° above: ${((100 * covered) / (w * h)).toFixed(1)} % of the frame (flat: ${((100 * flat) / (w * h)).toFixed(1)}), ${holes} pixels of holes`,
      );
      assert.ok(covered > 0.85 * flat, `${covered} pixels of ${flat}`);
      assert.ok(holes < 0.002 * covered, `${holes} of ${covered}`);
    }
    await context.close();
  });
});

// Compares WebGPU and WebGL2 with the program's f64 reference: twelve scenes from eight poses.
import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { mkdtempSync, readdirSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { fileURLToPath } from 'node:url';
import { HOME, lookingAt, POSE_KEYS } from '../../../static/view/camera.js';
import { disableGraphics, launch, openPage, pixelsAt } from '../support/browser.mjs';
import { boxContainer } from '../support/container.mjs';
import { serve } from '../support/fake-server.mjs';
import { png } from '../support/pictures.mjs';
import { lab, program } from '../support/program.mjs';

const FOLDER = fileURLToPath(new URL('../../golden/scenes/', import.meta.url));
/** Largest fraction of pixels off by more than 8 levels, and largest mean FLIP. Both drawn in software have 0.0033 and 0.012. */
const MOST_OFF = 0.004;
const MOST_FLIP = 0.014;
/** The view box of the scenes, their own and not the default (`crates/lab/tests/goldens.rs`). */
const REACH = 0.06;

/** Corners of the view box; four cameras look straight ahead, four turn. */
function poses() {
  const out = [];
  for (let corner = 0; corner < 8; corner++) {
    const side = (bit) => ((corner >> bit) & 1 ? -REACH : REACH);
    const [tx, ty, tz] = [0, 1, 2].map(side);
    out.push(corner < 4 ? { ...HOME, tx, ty, tz } : { ...lookingAt(0.5, tx, ty, tz), roll: corner - 5.5 });
  }
  return out;
}

const run = (file, ...args) => execFileSync(file, args, { encoding: 'utf8', stdio: ['ignore', 'pipe', 'ignore'] });

describe('scenes', () => {
  const scenes = readdirSync(FOLDER).filter((name) => name.endsWith('.tmpi'));
  let browser;
  let folder;
  let server;
  before(async () => {
    server = await serve({ atlas: boxContainer() });
    folder = mkdtempSync(join(tmpdir(), 'tmpi-scenes-'));
    browser = await launch();
  });
  after(async () => {
    await browser?.close();
    await server?.close();
    if (folder) rmSync(folder, { recursive: true });
  });

  /** The reference's picture of a scene at pose `i`, cached. */
  const drawn = new Map();
  function reference(scene, pose, i) {
    const path = join(folder, `${scene}-${i}.png`);
    if (!drawn.has(path)) {
      const text = POSE_KEYS.map((key) => pose[key]).join(',');
      const about = run(program, 'render', join(FOLDER, scene), '-o', path, '--pose', text, '--backend', 'reference', '--json');
      drawn.set(path, JSON.parse(about));
    }
    return { path, ...drawn.get(path) };
  }

  async function compare(t, mode) {
    assert.equal(scenes.length, 12);
    let [worstOff, worstFlip] = [0, 0];
    const { page, context, errors } = await openPage(browser);
    if (mode === 'webgl') await disableGraphics(page, { webgl: true });
    await page.route('**/scenes/*', (route) => {
      const name = new URL(route.request().url()).pathname.split('/').at(-1);
      return route.fulfill({ contentType: 'application/vnd.tmpi', body: readFileSync(join(FOLDER, name)) });
    });
    await page.goto(`${server.url}/embed?host=${server.url}`);
    for (const scene of scenes) {
      const drawnBy = await page.evaluate(async (src) => {
        const element = document.querySelector('tmpi-viewer');
        // a small canvas, for fast software rendering
        element.style.width = '200px';
        const loaded = new Promise((resolve, reject) => {
          element.addEventListener('load', resolve, { once: true });
          element.addEventListener('error', ({ detail }) => reject(new Error(detail.message)), { once: true });
        });
        element.src = src;
        return (await loaded).detail.mode;
      }, `/scenes/${scene}`);
      assert.equal(drawnBy, mode);
      for (const [i, pose] of poses().entries()) {
        const { path, width, height } = reference(scene, pose, i);
        const data = await pixelsAt(page, pose, width, height, 'tmpi-viewer');
        const browserPicture = join(folder, 'browser.png');
        writeFileSync(
          browserPicture,
          png(width, height, 3, (x, y) => data.subarray((y * width + x) * 4, (y * width + x) * 4 + 3)),
        );
        const figures = JSON.parse(run(lab, 'compare', path, browserPicture, '--json'));
        assert.ok(figures.share_off <= MOST_OFF && figures.flip <= MOST_FLIP, `${scene} from ${i}: ${JSON.stringify(figures)}`);
        [worstOff, worstFlip] = [Math.max(worstOff, figures.share_off), Math.max(worstFlip, figures.flip)];
      }
    }
    assert.deepEqual(errors, []);
    await context.close();
    t.diagnostic(
      `${mode}: at most ${(worstOff * 100).toFixed(3)} % of the pixels off by more than 8 levels, FLIP at most ${worstFlip.toFixed(4)}`,
    );
  }

  test('WebGPU draws the same as the reference', (t) => compare(t, 'gpu'));
  test('WebGL2 draws the same as the reference', (t) => compare(t, 'webgl'));
});

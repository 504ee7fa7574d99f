// Photos of every format and feature: what the program decodes them to is what Chromium shows of them, over white.
import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { dirname, join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { launch, openPage } from '../support/browser.mjs';
import { program } from '../support/program.mjs';

const decoded = join(dirname(program), 'examples/decoded');
/** Photos that there are at least. */
const LEAST = 300;
/** Photos a round trip to the page. */
const TOGETHER = 50;
/** Mean and largest difference in levels of 255. Decoders round differently, and smooth colours that have fewer samples differently. */
const BOUNDS = { mean: 0.8, most: 8 };
/** Photos that are decoded to something else on purpose, by their name, and why. */
const EXCEPTIONS = [
  {
    names: /^sampling-22-22-22-(interleaved|progressive)/,
    why: 'libjpeg takes no more than ten blocks in a unit, and Chromium shows black',
  },
  { names: /^sampling-41-21-11-separate/, why: 'neither decoder of the program reads it; it is refused' },
  { names: /^(half|no)-end-(.*-separate|nothing-interleaved)/, why: 'without an end marker Chromium leaves out the last rows, or all' },
  { names: /^no-end-(newline-interleaved|film-progressive)/, why: 'the same' },
  { names: /^half-end-(newline|film)-progressive/, why: 'the same' },
  { names: /^(profile|cicp)-linear-2-16/, why: 'Chromium rounds to eight bits before it converts, which shows in shadows' },
  { names: /^gamma-(1|primaries)/, why: 'gAMA and cHRM are passed over' },
  { names: /^orientation-[2-8]-opaque.*webp/, why: 'Chromium turns no WebP' },
  { names: /^animation-0-.*-clear/, why: 'Chromium takes a frame as opaque whose canvas does not say that it is clear' },
];

/** What Chromium makes of photos beside what the program does; runs in the page. */
async function compare(photos) {
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const one = async ({ name, file, rgb, width, height }) => {
    const image = new Image();
    image.src = URL.createObjectURL(new Blob([bytes(file)]));
    const shown = await image.decode().then(
      () => true,
      () => false,
    );
    URL.revokeObjectURL(image.src);
    if (!shown || !rgb) return { name, shown, taken: Boolean(rgb) };
    const { naturalWidth, naturalHeight } = image;
    if (naturalWidth !== width || naturalHeight !== height) return { name, shown, taken: true, size: [naturalWidth, naturalHeight] };
    const context = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true });
    context.fillStyle = 'white';
    context.fillRect(0, 0, width, height);
    context.drawImage(image, 0, 0);
    const { data } = context.getImageData(0, 0, width, height);
    const own = bytes(rgb);
    let [sum, most] = [0, 0];
    for (let i = 0; i < own.length; i++) {
      const off = Math.abs(own[i] - data[Math.floor(i / 3) * 4 + (i % 3)]);
      sum += off;
      most = Math.max(most, off);
    }
    return { name, shown, taken: true, mean: sum / own.length, most };
  };
  return Promise.all(photos.map(one));
}

describe('photos of every format and feature', () => {
  let folder = '';
  let browser;
  before(async () => {
    assert.ok(existsSync(decoded), `no ${decoded}: cargo build --release --workspace --examples makes it`);
    folder = mkdtempSync(join(tmpdir(), 'tmpi-formats-'));
    execFileSync(decoded, [folder]);
    browser = await launch({ webgpu: false });
  });
  after(async () => {
    await browser?.close();
    rmSync(folder, { recursive: true, force: true });
  });

  test('are decoded as Chromium shows them', async (t) => {
    const { page, context } = await openPage(browser);
    const text = (name) => readFileSync(join(folder, name)).toString('base64');
    const index = JSON.parse(readFileSync(join(folder, 'index.json'), 'utf8'));
    const photos = index.map((photo) => ({ ...photo, file: text(photo.name), rgb: photo.refused ? '' : text(`${photo.name}.rgb`) }));
    const results = [];
    for (let at = 0; at < photos.length; at += TOGETHER) results.push(...(await page.evaluate(compare, photos.slice(at, at + TOGETHER))));
    await context.close();
    assert.ok(results.length >= LEAST, `${results.length} photos`);

    const alike = ({ shown, taken, mean, most }) => shown === taken && (!taken || (mean <= BOUNDS.mean && most <= BOUNDS.most));
    const exceptional = ({ name }) => EXCEPTIONS.some(({ names }) => names.test(name));
    t.diagnostic(`${results.filter(alike).length} of ${results.length} photos are alike`);
    const wrong = results.filter((result) => !alike(result) && !exceptional(result));
    assert.deepEqual(wrong, [], `${wrong.length} of ${results.length} photos`);
    for (const { names, why } of EXCEPTIONS) {
      const of = results.filter(({ name }) => names.test(name));
      assert.ok(of.length > 0 && of.every((result) => !alike(result)), `no longer an exception: ${names}, ${why}`);
    }
  });
});

// The program decodes photos of every format and feature as Chromium shows them, over white.
import assert from 'node:assert/strict';
import { execFileSync } from 'node:child_process';
import { existsSync, mkdtempSync, readFileSync, rmSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { dirname, join } from 'node:path';
import { after, before, describe, test } from 'node:test';
import { launch, openPage } from '../support/browser.mjs';
import { program } from '../support/program.mjs';

const decoded = join(dirname(program), 'examples/photo_formats');
/** Minimum number of photos. */
const LEAST = 300;
/** Photos per round trip to the page. */
const BATCH = 50;
/** Mean and largest difference in levels of 255; decoders round and upsample chroma differently. */
const BOUNDS = { mean: 0.8, most: 8 };
/**
 * Photos that the program decodes differently on purpose, by name, with the reason; `since`: from this version of Chromium on. Compared with 148 and
 * 156.
 */
const EXCEPTIONS = [
  {
    names: /^sampling-22-22-22-(interleaved|progressive)/,
    why: 'libjpeg allows at most ten blocks per MCU, and Chromium shows black',
  },
  { names: /^sampling-41-21-11-separate/, why: 'neither decoder of the program reads it, so the program rejects it' },
  {
    names: /^((half|no)-end-(film-separate|nothing-interleaved)|half-end-newline-separate)/,
    why: 'without an end marker Chromium omits the last rows, or all rows',
  },
  { names: /^((half|no)-end-(nothing|samsung)|no-end-newline)-separate/, why: 'as above; Chromium 148 shows them', since: 149 },
  { names: /^no-end-(newline-interleaved|film-progressive)/, why: 'as above' },
  { names: /^half-end-(newline|film)-progressive/, why: 'as above' },
  { names: /^(profile|cicp)-linear-2-16/, why: 'Chromium rounds to eight bits before it converts, which changes shadows' },
  { names: /^gamma-(1|primaries)/, why: 'the program ignores gAMA and cHRM' },
  { names: /^orientation-[2-8]-opaque.*webp/, why: 'Chromium does not rotate WebP' },
  { names: /^animation-0-.*-clear/, why: 'Chromium treats a frame as opaque unless its canvas declares alpha' },
];

/** In the page: compares photos that Chromium decodes with those of the program. */
async function compare(photos) {
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const compareOne = async ({ name, file, rgb, width, height }) => {
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
  return Promise.all(photos.map(compareOne));
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

  test('decode as Chromium shows them', async (t) => {
    const { page, context } = await openPage(browser);
    const text = (name) => readFileSync(join(folder, name)).toString('base64');
    const index = JSON.parse(readFileSync(join(folder, 'index.json'), 'utf8'));
    const photos = index.map((photo) => ({ ...photo, file: text(photo.name), rgb: photo.refused ? '' : text(`${photo.name}.rgb`) }));
    const results = [];
    for (let at = 0; at < photos.length; at += BATCH) results.push(...(await page.evaluate(compare, photos.slice(at, at + BATCH))));
    await context.close();
    assert.ok(results.length >= LEAST, `${results.length} photos`);

    const isSame = ({ shown, taken, mean, most }) => shown === taken && (!taken || (mean <= BOUNDS.mean && most <= BOUNDS.most));
    const version = Number.parseInt(browser.version(), 10);
    const exceptions = EXCEPTIONS.filter(({ since }) => !since || version >= since);
    const isException = ({ name }) => exceptions.some(({ names }) => names.test(name));
    t.diagnostic(`${results.filter(isSame).length} of ${results.length} photos are the same`);
    const wrong = results.filter((result) => !isSame(result) && !isException(result));
    assert.deepEqual(wrong, [], `${wrong.length} of ${results.length} photos`);
    for (const { names, why } of exceptions) {
      const matches = results.filter(({ name }) => names.test(name));
      assert.ok(matches.length > 0 && matches.every((result) => !isSame(result)), `no longer an exception: ${names}, ${why}`);
    }
  });
});

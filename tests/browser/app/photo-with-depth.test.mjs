// Photos that come with a depth map: in the same folder, or embedded in the file.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { after, before, describe, test } from 'node:test';
import { filePixels, launch, openPage, waitForMode } from '../support/browser.mjs';
import { boxPhoto, inBox, png } from '../support/pictures.mjs';
import { startServer } from '../support/program.mjs';

const WIDTH = 320;
const HEIGHT = 200;
const [FAR, NEAR] = [40, 220];
/** A photo from a phone: 64 × 48 pixels, left half near. */
const PHONE = readFileSync(new URL('../../../fuzz/seeds/embedded_depth/gdepth.jpg', import.meta.url));

/** An 8-bit depth map of the box; `shade` makes the file unique. */
const map = (width, height, shade = 0) =>
  png(width, height, 1, (x, y) => [inBox(x, y, width, height) ? NEAR : FAR + (x + y === 0 ? shade : 0)]);

describe('photos with depth', () => {
  let server;
  let browser;
  before(async () => {
    server = await startServer();
    browser = await launch();
  });
  after(async () => {
    await browser?.close();
    await server?.close();
  });

  /** Drops a folder with `files`, each `[name, type, bytes]`, on the gallery page. */
  async function dropFolder(files) {
    const all = await openPage(browser);
    await all.page.goto(server.url);
    await all.page.evaluate(
      (entries) => {
        const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
        const entry = ([name, type, text]) => ({ isFile: true, file: (done) => done(new File([bytes(text)], name, { type })) });
        const children = entries.map(entry);
        const folder = { isDirectory: true, createReader: () => ({ readEntries: (done) => done(children.splice(0)) }) };
        DataTransferItem.prototype.webkitGetAsEntry = () => folder;
        const transfer = new DataTransfer();
        transfer.items.add(new File([''], 'holiday'));
        document.body.dispatchEvent(new DragEvent('drop', { bubbles: true, cancelable: true, dataTransfer: transfer }));
      },
      files.map(([name, type, file]) => [name, type, file.toString('base64')]),
    );
    return all;
  }

  const listed = async () => (await (await fetch(`${server.url}/v1/photos`)).json()).photos;

  /** Opens a photo; returns its id, the depth source in its menu, and the served depth map, 0 to 255. */
  async function openPhoto(page, name) {
    await page.getByRole('link', { name: `Open ${name}` }).click();
    await waitForMode(page, 'gpu');
    const id = new URL(page.url()).pathname.split('/').pop();
    await page.locator('#show').click();
    const line = page.locator('#show-menu #depth-source');
    await line.waitFor();
    const depth = (await filePixels(page, `/v1/photos/${id}/depth`)).filter((_, i) => i % 4 === 0);
    return { id, text: await line.textContent(), depth };
  }

  /** Mean depth of the box, and of the wall. */
  function means(depth) {
    const sums = [0, 0];
    const counts = [0, 0];
    depth.forEach((value, i) => {
      const which = inBox(i % WIDTH, Math.floor(i / WIDTH), WIDTH, HEIGHT) ? 0 : 1;
      sums[which] += value;
      counts[which]++;
    });
    return sums.map((sum, k) => sum / counts[k]);
  }

  test('a photo and its map become one photo', async () => {
    const before = (await listed()).length;
    const { page, context, errors } = await dropFolder([
      ['photo_depth.png', 'image/png', map(WIDTH, HEIGHT)],
      ['photo.png', 'image/png', boxPhoto(WIDTH, HEIGHT)],
    ]);
    const { id, text, depth } = await openPhoto(page, 'photo.png');
    assert.equal(text, 'Depth: a map of your own.');
    const photos = await listed();
    assert.equal(photos.length, before + 1, 'the map does not become a photo');
    assert.ok(photos[0].id === id && photos[0].depth_bytes > 0);
    const [box, wall] = means(depth);
    assert.ok(Math.abs(box - NEAR) < 4 && Math.abs(wall - FAR) < 4, `${box} and ${wall}, not ${NEAR} and ${FAR}`);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('a map of another shape is stretched with a note', async () => {
    const { page, context, errors } = await dropFolder([
      ['photo.png', 'image/png', boxPhoto(WIDTH, HEIGHT)],
      ['photo_depth.png', 'image/png', map(200, 200, 1)],
    ]);
    const { text, depth } = await openPhoto(page, 'photo.png');
    assert.equal(text, 'Depth: a map of your own. The map has another shape than the photo and was stretched.');
    const [box, wall] = means(depth);
    assert.ok(Math.abs(box - NEAR) < 8 && Math.abs(wall - FAR) < 8, `${box} and ${wall}, not ${NEAR} and ${FAR}`);
    assert.deepEqual(errors, []);
    await context.close();
  });

  test('the page names embedded depth', async () => {
    const { page, context, errors } = await dropFolder([['phone.jpg', 'image/jpeg', PHONE]]);
    const { text, depth } = await openPhoto(page, 'phone.jpg');
    assert.equal(text, 'Depth: from the photo itself.');
    const row = depth.slice(24 * 64, 25 * 64);
    assert.ok(Math.abs(row[8] - 255 * 0.84) < 3 && Math.abs(row[56] - 255 * 0.36) < 3, `${row[8]} and ${row[56]}`);
    assert.deepEqual(errors, []);
    await context.close();
  });
});

// Conversion of files other than JPEG, PNG and WebP before the upload, and messages for files that cannot be converted.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { kindOf, reduced } from '../../../static/app/convert.js';
import { boxPhoto } from '../support/pictures.mjs';
import { photo, uploadSuite } from '../support/upload-page.mjs';

const bytes = (text) => Buffer.from(text, 'latin1');
const LOSS = 'If the photo came with depth, it was lost in the conversion.';
const ftyp = (brands) => bytes(`\0\0\0\x18ftyp${brands}`);

describe('files to upload', () => {
  const suite = uploadSuite();

  test('are recognised by their first bytes', () => {
    for (const [head, kind] of [
      [bytes('\xff\xd8\xff\xe0'), 'JPEG'],
      [boxPhoto(2, 2), 'PNG'],
      [bytes('RIFF....WEBPVP8 '), 'WebP'],
      [bytes('GIF89a'), 'GIF'],
      [bytes('II*\0'), 'TIFF'],
      [ftyp('heic\0\0\0\0mif1heic'), 'HEIC'],
      [ftyp('mif1\0\0\0\0mif1avif'), 'AVIF'],
      [ftyp('mp42\0\0\0\0isommp42'), 'film'],
      [bytes('RIFF....WAVE'), null],
      [bytes(''), null],
    ])
      assert.equal(kindOf(head), kind, String(head));
  });

  test('large pictures shrink to the limits and keep their shape', () => {
    assert.equal(reduced({ width: 8000, height: 6000 }), null);
    const large = reduced({ width: 12_000, height: 9000 });
    assert.ok(large.width * large.height <= 50e6 && large.width * large.height > 49e6);
    assert.ok(Math.abs(large.width / large.height - 4 / 3) < 1e-3);
    assert.deepEqual(reduced({ width: 32_768, height: 100 }), { width: 16_384, height: 50 });
  });

  test('GIF and BMP are converted to PNG and JPEG', async () => {
    const { page, context, bodies } = await suite.open({
      posts: [
        { status: 202, json: photo('a') },
        { status: 202, json: photo('b') },
      ],
    });
    // one red pixel
    const gif = Buffer.from('R0lGODdhAQABAIAAAP8AAAAAACwAAAAAAQABAAACAkQBADs=', 'base64');
    await page.setInputFiles('#picker', { name: 'dot.gif', mimeType: 'image/gif', buffer: gif });
    await page.getByRole('link', { name: 'Open dot.gif' }).waitFor();
    assert.match(bodies[0], /filename="dot.png"\r\nContent-Type: image\/png/);
    const start = bodies[0].indexOf('\x89PNG');
    const png = Buffer.from(bodies[0].slice(start, bodies[0].indexOf('\r\n------', start)), 'latin1').toString('base64');
    const colour = await page.evaluate(async (data) => {
      const image = await createImageBitmap(new Blob([Uint8Array.from(atob(data), (c) => c.charCodeAt(0))]));
      const context = new OffscreenCanvas(1, 1).getContext('2d');
      context.drawImage(image, 0, 0);
      return [image.width, image.height, ...context.getImageData(0, 0, 1, 1).data];
    }, png);
    assert.deepEqual(colour, [1, 1, 255, 0, 0, 255]);
    const bmp = await page.evaluate(() => {
      const head = new DataView(new ArrayBuffer(58));
      head.setUint16(0, 0x424d);
      for (const [at, value] of [
        [2, 58],
        [10, 54],
        [14, 40],
        [18, 1],
        [22, 1],
      ])
        head.setUint32(at, value, true);
      head.setUint16(26, 1, true);
      head.setUint16(28, 24, true);
      return [...new Uint8Array(head.buffer)];
    });
    await page.setInputFiles('#picker', { name: 'dot.bmp', mimeType: 'image/bmp', buffer: Buffer.from(bmp) });
    await page.getByRole('link', { name: 'Open dot.bmp' }).waitFor();
    assert.match(bodies[1], /filename="dot.jpg"\r\nContent-Type: image\/jpeg\r\n\r\n\xff\xd8\xff/);
    await context.close();
  });

  test('unreadable files are rejected with advice and not sent', async () => {
    const { page, context, sent } = await suite.open({});
    for (const [name, buffer, message] of [
      ['phone.heic', ftyp('heic\0\0\0\0mif1heic'), /iPhone.*Most Compatible/],
      ['scan.tif', bytes('II*\0'), /cannot read TIFF\. Save the photo as JPEG/],
      ['walk.mov', ftyp('qt  \0\0\0\0qt  '), /film, not a photo/],
      ['nothing.jpg', bytes(''), /empty/],
    ]) {
      await page.setInputFiles('#picker', { name, mimeType: 'image/x', buffer });
      const row = page.locator('.upload.failed').filter({ hasText: name });
      assert.match(await row.locator('.upload-state').textContent(), message);
    }
    assert.deepEqual(sent, []);
    assert.equal(await page.locator('#uploads-total').textContent(), '4 failed');
    await page.getByRole('button', { name: 'Dismiss failed' }).click();
    await page.locator('#uploads').waitFor({ state: 'hidden' });
    await context.close();
  });

  test('a file over the limit shrinks and stays upright', async () => {
    const { page, context } = await suite.open({});
    const made = await page.evaluate(async () => {
      const { prepared } = await import('/static/app/convert.js');
      const canvas = new OffscreenCanvas(60, 40);
      const context = canvas.getContext('2d');
      context.fillStyle = '#0c0';
      context.fillRect(0, 0, 60, 40);
      const jpeg = new Uint8Array(await (await canvas.convertToBlob({ type: 'image/jpeg' })).arrayBuffer());
      // EXIF orientation 6, and more bytes than the server accepts
      const exif = [
        0xff,
        0xe1,
        0,
        34,
        ...[...'Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0'].map((c) => c.charCodeAt(0)),
      ];
      const file = new File([jpeg.subarray(0, 2), new Uint8Array(exif), jpeg.subarray(2), new Uint8Array(33 * 2 ** 20)], 'large.jpeg');
      const losses = [];
      const out = await prepared(file, (loss) => losses.push(loss));
      const image = await createImageBitmap(out);
      return { name: out.name, type: out.type, small: out.size < 10_000, size: [image.width, image.height], losses };
    });
    assert.deepEqual(made, { name: 'large.jpg', type: 'image/jpeg', small: true, size: [40, 60], losses: [LOSS] });
    await context.close();
  });
});

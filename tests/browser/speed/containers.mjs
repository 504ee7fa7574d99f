// Makes containers of one photo in several sizes.
import { execFileSync } from 'node:child_process';
import { readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { launch } from '../support/browser.mjs';
import { program } from '../support/program.mjs';

/** The paper's picture size, sizes around it, and 9.1 megapixels. */
export const SIZES = [
  [320, 178],
  [630, 350],
  [1024, 569],
  [2048, 1138],
  [4048, 2248],
];

/** In the page: crops and resizes the photo; returns JPEG in base64. */
async function resize([photo, width, height]) {
  const bitmap = await createImageBitmap(await (await fetch(photo)).blob());
  const scale = Math.max(width / bitmap.width, height / bitmap.height);
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext('2d');
  context.imageSmoothingQuality = 'high';
  const [w, h] = [bitmap.width * scale, bitmap.height * scale];
  context.drawImage(bitmap, (width - w) / 2, (height - h) / 2, w, h);
  const bytes = new Uint8Array(await (await canvas.convertToBlob({ type: 'image/jpeg', quality: 0.9 })).arrayBuffer());
  return bytes.toBase64();
}

/**
 * Writes resized photos and their containers.
 * @param {string} photo file, JPEG or PNG
 * @param {string} folder to write to
 * @returns {Promise<{photo: string, container: string}[]>} paths for each of `SIZES`
 */
export async function containersOf(photo, folder) {
  const address = `data:image/${photo.endsWith('.png') ? 'png' : 'jpeg'};base64,${readFileSync(photo).toString('base64')}`;
  const browser = await launch({ webgpu: false });
  const page = await browser.newPage();
  const made = [];
  for (const [width, height] of SIZES) {
    const names = { photo: join(folder, `${width}x${height}.jpg`), container: join(folder, `${width}x${height}.tmpi`) };
    writeFileSync(names.photo, Buffer.from(await page.evaluate(resize, [address, width, height]), 'base64'));
    execFileSync(program, ['make', '-q', '-o', names.container, names.photo], { stdio: ['ignore', 'ignore', 'inherit'] });
    made.push(names);
  }
  await browser.close();
  return made;
}

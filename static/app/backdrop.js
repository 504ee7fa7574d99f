// The backdrop behind the photo.

import { $ } from './dom.js';

const SIZE = [12, 9];

/**
 * Fills the space around the photo with its colours: a few pixels drawn large, which costs no time per frame.
 * @param {HTMLImageElement} image
 */
export async function showBackdrop(image) {
  await image.decode().catch(() => {});
  if (!image.naturalWidth) return;
  const canvas = $('backdrop', HTMLCanvasElement);
  [canvas.width, canvas.height] = SIZE;
  const context = canvas.getContext('2d');
  if (!context) return;
  context.imageSmoothingQuality = 'high';
  context.drawImage(image, 0, 0, canvas.width, canvas.height);
  canvas.hidden = false;
}

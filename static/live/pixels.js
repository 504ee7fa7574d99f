// The samples of a decoded picture, without the browser's own conversion of colours where there is a choice.

import { PIXELS } from './decoder.js';

/**
 * @param {VideoFrame | ImageBitmap} picture of that size; closed by the caller
 * @param {{width: number, height: number}} size
 * @param {boolean} copies whether samples may be copied as they are
 * @returns {Promise<{format: number, bytes: Uint8Array | Uint8ClampedArray}>} planes without gaps
 */
export async function pixelsOf(picture, { width, height }, copies) {
  const format = 'format' in picture ? picture.format : null;
  if (copies && 'copyTo' in picture && (format === 'I420' || format === 'NV12')) {
    const rect = picture.visibleRect ?? undefined;
    const across = Math.ceil(width / 2);
    const down = Math.ceil(height / 2);
    const luma = { offset: 0, stride: width };
    const layout =
      format === 'NV12'
        ? [luma, { offset: width * height, stride: 2 * across }]
        : [luma, { offset: width * height, stride: across }, { offset: width * height + across * down, stride: across }];
    const bytes = new Uint8Array(width * height + 2 * across * down);
    if (rect?.width !== width || rect.height !== height) throw new Error('a frame of another size');
    await picture.copyTo(bytes, { rect, layout });
    return { format: format === 'NV12' ? PIXELS.NV12 : PIXELS.I420, bytes };
  }
  const context = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true });
  if (!context) throw new Error('the browser has no canvas for workers');
  context.drawImage(picture, 0, 0);
  return { format: PIXELS.RGBA, bytes: context.getImageData(0, 0, width, height).data };
}

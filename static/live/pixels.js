// The samples of a decoded picture, without the browser's own conversion of colours where there is a choice.

import { PIXELS } from './decoder.js';

/**
 * The part of a frame's samples that is shown. Some decoders cut off what VP9's size for drawing leaves out, which others pass over.
 * @param {VideoFrame} picture
 * @param {number} width
 * @param {number} height
 */
function shownOf({ visibleRect, codedWidth, codedHeight }, width, height) {
  if (visibleRect?.width === width && visibleRect.height === height) return visibleRect;
  if (codedWidth < width || codedHeight < height) throw new Error('A frame has another size than the room.');
  return { x: visibleRect?.x ?? 0, y: visibleRect?.y ?? 0, width, height };
}

/**
 * @param {VideoFrame | ImageBitmap} picture of that size; closed by the caller
 * @param {{width: number, height: number}} size
 * @param {boolean} copies whether samples may be copied as they are
 * @returns {Promise<{format: number, bytes: Uint8Array | Uint8ClampedArray}>} planes without gaps
 */
export async function pixelsOf(picture, { width, height }, copies) {
  const format = 'format' in picture ? picture.format : null;
  if (copies && 'copyTo' in picture && (format === 'I420' || format === 'NV12')) {
    const rect = shownOf(picture, width, height);
    const across = Math.ceil(width / 2);
    const down = Math.ceil(height / 2);
    const luma = { offset: 0, stride: width };
    const layout =
      format === 'NV12'
        ? [luma, { offset: width * height, stride: 2 * across }]
        : [luma, { offset: width * height, stride: across }, { offset: width * height + across * down, stride: across }];
    const bytes = new Uint8Array(width * height + 2 * across * down);
    await picture.copyTo(bytes, { rect, layout });
    return { format: format === 'NV12' ? PIXELS.NV12 : PIXELS.I420, bytes };
  }
  const context = new OffscreenCanvas(width, height).getContext('2d', { willReadFrequently: true });
  if (!context) throw new Error('the browser has no canvas for workers');
  context.drawImage(picture, 0, 0, width, height);
  return { format: PIXELS.RGBA, bytes: context.getImageData(0, 0, width, height).data };
}

// The samples of a decoded picture, without the browser's own conversion of colours where there is a choice.

import { PIXELS } from './decoder.js';

/**
 * The part of a frame's samples that is shown. Some decoders leave to the left what is no multiple of their vectors, though it is to be cut off;
 * others cut off what VP9's size for drawing leaves out.
 * @param {VideoFrame} picture
 * @param {number} width
 * @param {number} height
 */
function shownOf({ visibleRect, codedWidth, codedHeight }, width, height) {
  const seen = visibleRect ?? { x: 0, y: 0, width: codedWidth, height: codedHeight };
  const rect = { x: seen.x + Math.max(0, seen.width - width), y: seen.y + Math.max(0, seen.height - height), width, height };
  if (rect.x + width > codedWidth || rect.y + height > codedHeight) throw new Error('A frame has another size than the room.');
  return rect;
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
  if ('visibleRect' in picture && picture.visibleRect) {
    const { x, y } = picture.visibleRect;
    const rect = shownOf(picture, width, height);
    // places are those of the picture as it is to be drawn, whose pixels need not be square
    const [across, down] = [picture.displayWidth / picture.visibleRect.width, picture.displayHeight / picture.visibleRect.height];
    context.drawImage(picture, (rect.x - x) * across, (rect.y - y) * down, width * across, height * down, 0, 0, width, height);
  } else context.drawImage(picture, 0, 0, width, height);
  return { format: PIXELS.RGBA, bytes: context.getImageData(0, 0, width, height).data };
}

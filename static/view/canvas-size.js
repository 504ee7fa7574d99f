// Sizes of the pictures in the viewer: whole, in the photo's aspect ratio.

/** Most device pixels per CSS pixel. */
const MAX_PIXEL_RATIO = 2;
/** Largest area of the canvas, pixels. */
const MAX_PIXELS = 6_000_000;

export function pixelRatio() {
  return Math.min(devicePixelRatio || 1, MAX_PIXEL_RATIO);
}

/**
 * Size of a picture of that aspect ratio that fits into an element, CSS pixels; null if the element has no area.
 * @param {{clientWidth: number, clientHeight: number}} element
 * @param {number} aspect
 */
export function fitted({ clientWidth, clientHeight }, aspect) {
  if (!clientWidth || !clientHeight) return null;
  const width = Math.min(clientWidth, clientHeight * aspect);
  return { width, height: width / aspect };
}

/**
 * Sets the resolution of a canvas: the screen's times `detail`, with no side longer than `side`.
 * @param {{width: number, height: number}} canvas
 * @param {{width: number, height: number}} size
 * @param {number} detail
 * @param {number} side
 */
export function setPixels(canvas, { width, height }, detail, side) {
  const ratio = detail * Math.min(pixelRatio(), Math.sqrt(MAX_PIXELS / (width * height)), side / Math.max(width, height));
  const size = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
  // setting the size clears the canvas even if it does not change
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
}

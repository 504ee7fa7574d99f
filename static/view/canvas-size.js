// Sizes of the pictures in the viewer: whole, in the photo's own shape.

/** Device pixels per CSS pixel that are drawn at most. */
const MAX_PIXEL_RATIO = 2;
/** Largest area of the canvas, pixels. */
const MAX_PIXELS = 6_000_000;

export function pixelRatio() {
  return Math.min(devicePixelRatio || 1, MAX_PIXEL_RATIO);
}

/** CSS pixels of a picture of that aspect that fits into an element, or null where the element has no area. */
export function fitted({ clientWidth, clientHeight }, aspect) {
  if (!clientWidth || !clientHeight) return null;
  const width = Math.min(clientWidth, clientHeight * aspect);
  return { width, height: width / aspect };
}

/** Gives a canvas its pixels: `detail` of what the screen shows a side, no side longer than `side`. */
export function setPixels(canvas, { width, height }, detail, side) {
  const ratio = detail * Math.min(pixelRatio(), Math.sqrt(MAX_PIXELS / (width * height)), side / Math.max(width, height));
  const size = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
  // setting a size clears the canvas even where it stays the same
  if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
}

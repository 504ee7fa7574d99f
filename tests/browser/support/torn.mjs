// Finds torn edges of the film's box (video.mjs) in a picture from a moved pose.

/** Difference of red and blue from which a pixel is the box's: its chroma is (100, 165), the wall's (140, 118). */
const RED = 25;
/** Rows of the box that count, as fractions of the picture's height. */
const [TOP, BOTTOM] = [0.34, 0.9];
/** Pixels, at 320×240, off an edge's line from which a row is torn. */
const STEP = 3;

const median = (list) => list.toSorted((a, b) => a - b)[list.length >> 1];

/** Fraction of rows in which an edge, as [row, column], is off its own line, which is robust: medians of slopes and of offsets. */
function offLine(edge, step) {
  const half = edge.length >> 1;
  const slope = median(edge.slice(half).map(([y, x], i) => (x - edge[i][1]) / (y - edge[i][0])));
  const at = median(edge.map(([y, x]) => x - slope * y));
  return edge.filter(([y, x]) => Math.abs(x - slope * y - at) > step).length / edge.length;
}

/** Fraction of torn rows of the worse edge: steps between tiles, and specks that stay behind. 1 if most rows do not show the box. */
export function tornRows(pixels, width, height) {
  const edges = [[], []];
  const [top, bottom] = [Math.round(TOP * height), Math.round(BOTTOM * height)];
  for (let y = top; y < bottom; y++) {
    const red = [];
    for (let x = 0; x < width; x++) if (pixels[(y * width + x) * 4] - pixels[(y * width + x) * 4 + 2] > RED) red.push(x);
    if (red.length < width / 8) continue; // not the box
    edges[0].push([y, red[0]]);
    edges[1].push([y, red.at(-1)]);
  }
  if (edges[0].length < (bottom - top) / 2) return 1;
  return Math.max(...edges.map((edge) => offLine(edge, (STEP * width) / 320)));
}

// The grid of tiles over a photo: `Grid` of crates/core.

/** @typedef {{width: number, height: number, tileSize: number, tileStride: number}} Grid size of the photo, side of the tiles, and distance from one to the next */

/**
 * @param {number} length
 * @param {number} size
 * @param {number} stride
 */
function count(length, size, stride) {
  return length <= size ? 1 : Math.ceil((length - size) / stride) + 1;
}

/**
 * Counts of columns and tiles in a grid.
 * @param {Grid} grid
 */
export function tileCounts({ width, height, tileSize, tileStride }) {
  const columns = count(width, tileSize, tileStride);
  return { columns, tiles: columns * count(height, tileSize, tileStride) };
}

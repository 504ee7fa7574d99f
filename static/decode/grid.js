// The grid of tiles over a photo, as src/tmpi/grid.rs.

function count(length, size, stride) {
  return length <= size ? 1 : Math.ceil((length - size) / stride) + 1;
}

/** `{columns, tiles}` of a grid. */
export function tileCounts({ width, height, tileSize, tileStride }) {
  const columns = count(width, tileSize, tileStride);
  return { columns, tiles: columns * count(height, tileSize, tileStride) };
}

/** Pixels of tile `index`, row by row, clipped to the photo. */
export function tileRect({ width, height, tileSize, tileStride }, columns, index) {
  const x = (index % columns) * tileStride;
  const y = Math.floor(index / columns) * tileStride;
  return { x, y, w: Math.min(tileSize, width - x), h: Math.min(tileSize, height - y) };
}

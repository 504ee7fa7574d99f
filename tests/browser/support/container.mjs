// Containers of a box in front of a wall (tests/golden/box), written by hand from proto/tmpi.proto.
import { readFileSync } from 'node:fs';

/** The scene's head; its photo is `boxPhoto` of that size. */
export const BOX_HEAD = {
  width: 200,
  height: 120,
  tileSize: 64,
  tileStride: 56,
  intrinsics: { fx: 116, fy: 116, cx: 100, cy: 60 },
  viewBox: { x: 0.03, y: 0.03, z: 0.03 },
};

/** The container, 200 × 120 or 400 × 240. */
export function boxContainer(width = BOX_HEAD.width, height = BOX_HEAD.height) {
  return readFileSync(new URL(`../../golden/box/${width}x${height}.tmpi`, import.meta.url));
}

// Detects deep stacks of soft texels, for which 8 bits per layer are not enough.

/** @import { Layers } from '../decode/scene.js' */
/** @import { Piece } from './border.js' */
/** @import { Places } from './texture-atlas.js' */

/** Most stacked soft texels that are blended in 8 bits: each may round by half a level. */
const STACK = 4;
/** Most bytes of an atlas of 16-bit floats; a larger one may exhaust the device's memory, and nothing would be drawn. */
const MOST_BYTES = 128 * 1024 * 1024;
/** Alpha from which a texel counts as opaque, as in tmpi.wgsl. */
const OPAQUE = 0.99 * 255;

/**
 * Whether an atlas of 16-bit floats stays within the memory limit.
 * @param {Pick<Places, 'width' | 'height' | 'pages'>} places
 */
export function floatsFit({ width, height, pages }) {
  return width * height * pages * 8 <= MOST_BYTES;
}

/**
 * Whether any pixel of the photo has more than `STACK` soft texels, of one tile or of several that overlap.
 * @param {{width: number, height: number}} photo
 * @param {Pick<Layers, 'w' | 'h' | 'soft' | 'count'>} layers of these tiles
 * @param {Uint8Array} alpha alphas of all their texels
 * @param {Piece[]} pieces of these layers
 */
export function hasDeepStacks({ width, height }, layers, alpha, pieces) {
  const firstTexel = new Float64Array(layers.count);
  for (let i = 1; i < layers.count; i++) firstTexel[i] = firstTexel[i - 1] + layers.w[i - 1] * layers.h[i - 1];
  const over = new Uint8Array(width * height);
  for (const p of pieces) {
    // mirror images beyond the border have the same stacks
    if (p.flipX || p.flipY || !layers.soft[p.layer]) continue;
    const [left, right] = [Math.floor(p.left), Math.ceil(p.right)];
    for (let v = Math.floor(p.upper); v < Math.ceil(p.lower); v++) {
      const texel = firstTexel[p.layer] + v * layers.w[p.layer];
      const pixel = (p.y + v) * width + p.x;
      for (let u = left; u < right; u++) {
        const a = alpha[texel + u];
        if (a > 0 && a < OPAQUE && ++over[pixel + u] > STACK) return true;
      }
    }
  }
  return false;
}

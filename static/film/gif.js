// Films as GIF: one palette for all frames prevents flicker, and ordered dithering prevents banding in skies.

/** @import { Plan } from './plan.js' */
/** @import { Writer } from './film.js' */

const COLOURS = 256;
/** Count of frames that the palette is computed from, and most pixels of each. */
const SAMPLE_FRAMES = 4;
const SAMPLE_PIXELS = 40_000;
/** Amplitude of the dithering, levels of 255. */
const DITHER_AMPLITUDE = 10;
/** Thresholds of ordered dithering, 0 to 15 (Bayer 1973). */
const BAYER = [0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5];

/**
 * @param {Plan} plan
 * @param {(share: number) => Promise<ImageData>} sample draws a frame
 * @returns {Promise<Writer>}
 */
export async function gifWriter({ width, height, frameMs }, sample) {
  const { GIFEncoder, quantize, applyPalette } = await import(new URL('../vendor/gifenc.mjs', import.meta.url).href);
  const samples = [];
  for (let i = 0; i < SAMPLE_FRAMES; i++) samples.push(subsampled((await sample(i / SAMPLE_FRAMES)).data));
  const palette = quantize(joined(samples), COLOURS, { format: 'rgb565' });
  const gif = GIFEncoder();
  let first = true;
  return {
    async add({ data }) {
      dither(data, width);
      const index = applyPalette(data, palette, 'rgb565');
      gif.writeFrame(index, width, height, { delay: frameMs, ...(first && { palette, repeat: 0 }) });
      first = false;
    },
    async finish() {
      gif.finish();
      return new Blob([gif.bytes()], { type: 'image/gif' });
    },
    close() {},
  };
}

/**
 * Adds the dithering pattern.
 * @param {Uint8ClampedArray} data RGBA
 * @param {number} width
 */
export function dither(data, width) {
  for (let i = 0; i < data.length; i += 4) {
    const [x, y] = [(i / 4) % width, Math.floor(i / 4 / width)];
    const add = ((BAYER[(y % 4) * 4 + (x % 4)] + 0.5) / 16 - 0.5) * DITHER_AMPLITUDE;
    for (let c = 0; c < 3; c++) data[i + c] += add;
  }
}

/**
 * A regular subset of the pixels.
 * @param {Uint8ClampedArray} data RGBA
 */
function subsampled(data) {
  const step = Math.max(1, Math.floor(data.length / 4 / SAMPLE_PIXELS));
  const out = new Uint8ClampedArray(Math.ceil(data.length / 4 / step) * 4);
  for (let i = 0, o = 0; i < data.length; i += 4 * step, o += 4) out.set(data.subarray(i, i + 4), o);
  return out;
}

/** @param {Uint8ClampedArray[]} parts */
function joined(parts) {
  const out = new Uint8ClampedArray(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    out.set(part, at);
    at += part.length;
  }
  return out;
}

// A film for the fake camera: a textured box moves in front of a wall, and each frame contains its number.
import { writeFileSync } from 'node:fs';

export const [WIDTH, HEIGHT] = [320, 240];
export const FRAMES = 60;
/** The number is a row of squares at the top left, most significant bit first. */
const BITS = 6;
export const SQUARE = 16;

/** Left edge of the box in a frame. */
export const boxAt = (n) => Math.round(110 + 40 * Math.sin((2 * Math.PI * n) / FRAMES));
const [TOP, BOTTOM, ACROSS] = [70, 230, 100];

/** Luma and chroma of a pixel of frame `n`; limited range. */
function sample(n, x, y) {
  if (y < SQUARE && x < SQUARE * BITS) return [(n >> (BITS - 1 - Math.floor(x / SQUARE))) & 1 ? 220 : 30, 128, 128];
  const left = boxAt(n);
  if (y >= TOP && y < BOTTOM && x >= left && x < left + ACROSS)
    return [150 + 50 * Math.sin((x - left) / 4) * Math.cos((y - TOP) / 6), 100, 165];
  return [90 + 40 * Math.sin(x / 11) + 20 * Math.cos(y / 9), 140 + 10 * Math.sin(x / 40), 118];
}

/** Y, U and V planes of frame `n`, scaled by `times`. */
export function planes(n, times = 1) {
  const [width, height] = [WIDTH * times, HEIGHT * times];
  const out = Buffer.alloc((width * height * 3) / 2);
  const chroma = (width * height) / 4;
  const [us, vs] = [new Float64Array(chroma), new Float64Array(chroma)];
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const [luma, u, v] = sample(n, x / times, y / times);
      out[y * width + x] = Math.round(luma);
      // a camera's chroma is the mean of four pixels
      const at = (y >> 1) * (width / 2) + (x >> 1);
      us[at] += u / 4;
      vs[at] += v / 4;
    }
  }
  out.set(us.map(Math.round), width * height);
  out.set(vs.map(Math.round), width * height + chroma);
  return out;
}

/** Writes the film as YUV4MPEG2, scaled by `times`. */
export function writeFilm(file, times = 1) {
  const head = Buffer.from(`YUV4MPEG2 W${WIDTH * times} H${HEIGHT * times} F30:1 Ip A1:1 C420jpeg\n`);
  const frames = Array.from({ length: FRAMES }, (_, n) => [Buffer.from('FRAME\n'), planes(n, times)]).flat();
  writeFileSync(file, Buffer.concat([head, ...frames]));
}

const decoded = new Map();
/** RGBA of frame `n`, made once: BT.709, limited range. */
export function rgba(n) {
  if (!decoded.has(n)) decoded.set(n, converted(n));
  return decoded.get(n);
}

function converted(n) {
  const film = planes(n);
  const out = new Uint8ClampedArray(WIDTH * HEIGHT * 4);
  const chroma = (WIDTH * HEIGHT) / 4;
  for (let i = 0; i < WIDTH * HEIGHT; i++) {
    const at = WIDTH * HEIGHT + Math.floor(Math.floor(i / WIDTH) / 2) * (WIDTH / 2) + Math.floor((i % WIDTH) / 2);
    const [y, u, v] = [(film[i] - 16) / 219, (film[at] - 128) / 224, (film[at + chroma] - 128) / 224];
    out.set([255 * (y + 1.5748 * v), 255 * (y - 0.18732 * u - 0.46812 * v), 255 * (y + 1.8556 * u), 255], i * 4);
  }
  return out;
}

/** Reads the frame number from a picture. */
export function frameNumber(pixels) {
  let n = 0;
  for (let bit = 0; bit < BITS; bit++) {
    const at = ((SQUARE / 2) * WIDTH + bit * SQUARE + SQUARE / 2) * 4;
    n = n * 2 + Number(pixels[at + 1] > 128);
  }
  return n;
}

/** Peak signal-to-noise ratio in dB over all channels in a rectangle. */
export function psnr(a, b, { x0 = 0, y0 = 0, x1 = WIDTH, y1 = HEIGHT } = {}) {
  let [sum, count] = [0, 0];
  for (let y = y0; y < y1; y++) {
    for (let x = x0; x < x1; x++) {
      for (let c = 0; c < 3; c++) {
        sum += (a[(y * WIDTH + x) * 4 + c] - b[(y * WIDTH + x) * 4 + c]) ** 2;
        count++;
      }
    }
  }
  return 10 * Math.log10((255 * 255 * count) / Math.max(sum, 1e-9));
}

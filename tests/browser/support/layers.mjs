// Scenes with layers over the whole photo, as the decoder would return them, and their expected picture from the front.
import { assembled } from '../../../static/decode/assemble.js';
import { Band } from '../../../static/decode/band.js';
import { Decoder } from '../../../static/decode/decoder.js';

/**
 * A scene of planes in front of each other; every texel is hidden and has its own colour.
 * @param {{delta: number, alpha: number, colour: (x: number, y: number) => number[]}[]} planes in layer order, far to near
 * @param {{width?: number, height?: number}} [size]
 */
export function planeScene(planes, { width = 48, height = 32 } = {}) {
  const n = planes.length;
  const size = width * height;
  const all = (Kind, value) => Kind.from({ length: n }, (_, i) => (typeof value === 'function' ? value(i) : value));
  const alpha = Uint8Array.from({ length: n * size }, (_, i) => planes[Math.floor(i / size)].alpha);
  const focal = 0.7 * width;
  return {
    width,
    height,
    tileSize: 64,
    tileStride: 64,
    intrinsics: { fx: focal, fy: focal, cx: width / 2, cy: height / 2 },
    viewBox: { x: 0, y: 0, z: 0 },
    layers: {
      count: n,
      a: all(Float64Array, (i) => planes[i].delta),
      b: all(Float64Array, 0),
      c: all(Float64Array, 0),
      x: all(Uint32Array, 0),
      y: all(Uint32Array, 0),
      w: all(Uint32Array, width),
      h: all(Uint32Array, height),
      tileX: all(Uint32Array, 0),
      tileY: all(Uint32Array, 0),
      visible: all(Uint32Array, 0),
      soft: all(Uint8Array, (i) => Number(planes[i].alpha < 255)),
    },
    alpha,
  };
}

/** A fake decoder for `Band` that returns planes instead of a container's layers. */
function fakeDecoder(planes, { layers, alpha }) {
  return {
    alpha,
    open() {},
    picture() {},
    decode: () => layers,
    strip(pieces, width, height, straight) {
      const out = new Uint8Array(width * height * 4);
      for (let k = 0; k < pieces.length; k += 7) {
        const [layer, u, v, w, h, mirrored, at] = pieces.subarray(k, k + 7);
        if (mirrored) throw new Error('the scene must not reach beyond the border');
        const { alpha, colour } = planes[layer];
        const factor = straight ? 1 : alpha / 255;
        for (let y = 0; y < h; y++) {
          for (let x = 0; x < w; x++) {
            out.set([...colour(u + x, v + y).map((value) => Math.round(value * factor)), alpha], (y * width + at + x) * 4);
          }
        }
      }
      return out;
    },
  };
}

/** The scene of `planeScene`, assembled as pages do. */
export async function assembledPlaneScene(test, planes, size) {
  const given = planeScene(planes, size);
  const { width, height } = given;
  const mocked = test.mock.method(Decoder, 'of', async () => fakeDecoder(planes, given));
  const photo = { width, height, data: new Uint8ClampedArray(width * height * 4) };
  const { alpha, layers, ...head } = given;
  const { scene } = await assembled({ scene: head, reach: 0 }, { bytes: new Uint8Array(), photo, hidden: null }, [new Band(null)]);
  mocked.mock.restore();
  return { ...scene, decodeMs: 0 };
}

/** Composites planes, nearest last; returns the unrounded premultiplied colour from 0 to 255. */
export function composite(planes, x, y) {
  let sum = [0, 0, 0, 0];
  for (const { alpha, colour } of planes) {
    const a = alpha / 255;
    sum = [...colour(x, y), 255].map((value, c) => value * a + sum[c] * (1 - a));
  }
  return sum;
}

/** Draws a scene with one backend at a pose and the photo's size; returns premultiplied RGBA, and whether it was drawn in floats. */
export async function drawScene(page, mode, scene, pose) {
  const json = JSON.stringify(scene, (_, value) =>
    ArrayBuffer.isView(value) ? { kind: value.constructor.name, values: [...value] } : value,
  );
  const { pixels, wide } = await page.evaluate(
    async ([text, kind, at]) => {
      const { WebGpuRenderer } = await import('/static/draw/webgpu.js');
      const { WebGlRenderer } = await import('/static/draw/webgl.js');
      const { HOME } = await import('/static/view/camera.js');
      const parsed = JSON.parse(text, (_, value) => (value?.kind ? window[value.kind].from(value.values) : value));
      const lost = () => {};
      const canvas = document.createElement('canvas');
      const renderer = await (kind === 'gpu' ? WebGpuRenderer.create(parsed, lost) : WebGlRenderer.create(canvas, parsed, lost));
      const data = await renderer.readPixels({ ...HOME, ...at }, parsed.intrinsics, parsed.width, parsed.height);
      const result = { pixels: [...data], wide: renderer.wide };
      renderer.dispose();
      return result;
    },
    [json, mode, pose],
  );
  return { pixels: Uint8ClampedArray.from(pixels), wide };
}

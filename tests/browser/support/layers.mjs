// Scenes of layers over the whole photo, made as the decoder would give them, and what is seen of them straight ahead.

/**
 * Layers in front of each other: every texel is hidden and has a colour of its own.
 * @param {{delta: number, alpha: number, colour: (x: number, y: number) => number[]}[]} planes in layer order, far to near
 * @param {{width?: number, height?: number}} [size]
 */
export function layerScene(planes, { width = 48, height = 32 } = {}) {
  const n = planes.length;
  const size = width * height;
  const all = (Kind, value) => Kind.from({ length: n }, (_, i) => (typeof value === 'function' ? value(i) : value));
  const hidden = new Uint8Array(n * size * 3);
  const alpha = new Uint8Array(n * size);
  planes.forEach((plane, i) => {
    for (let y = 0; y < height; y++) for (let x = 0; x < width; x++) hidden.set(plane.colour(x, y), (i * size + y * width + x) * 3);
    alpha.fill(plane.alpha, i * size, (i + 1) * size);
  });
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
      firstTexel: all(Uint32Array, (i) => i * size),
      firstHidden: all(Uint32Array, (i) => i * size),
      visible: all(Uint32Array, 0),
      soft: all(Uint8Array, (i) => Number(planes[i].alpha < 255)),
    },
    classes: new Uint8Array(n * size).fill(2),
    alpha,
    hidden,
    photo: { width, height, data: new Uint8ClampedArray(size * 4) },
    decodeMs: 0,
  };
}

/** Premultiplied colour of planes over each other, nearest last, as numbers from 0 to 255 that nothing has rounded. */
export function over(planes, x, y) {
  let sum = [0, 0, 0, 0];
  for (const { alpha, colour } of planes) {
    const a = alpha / 255;
    sum = [...colour(x, y), 255].map((value, c) => value * a + sum[c] * (1 - a));
  }
  return sum;
}

/** Draws a scene in the page by one backend, at a pose, in the photo's size: premultiplied RGBA and whether it was drawn in floats. */
export async function drawn(page, mode, scene, pose) {
  const sent = JSON.stringify(scene, (_, value) =>
    ArrayBuffer.isView(value) ? { kind: value.constructor.name, values: [...value] } : value,
  );
  const { pixels, wide } = await page.evaluate(
    async ([text, kind, at]) => {
      const { WebGpuRenderer } = await import('/static/draw/webgpu.js');
      const { WebGlRenderer } = await import('/static/draw/webgl.js');
      const { HOME } = await import('/static/view/camera.js');
      const own = JSON.parse(text, (_, value) => (value?.kind ? window[value.kind].from(value.values) : value));
      const lost = () => {};
      const canvas = document.createElement('canvas');
      const renderer = await (kind === 'gpu' ? WebGpuRenderer.create(own, lost) : WebGlRenderer.create(canvas, own, lost));
      const data = await renderer.readPixels({ ...HOME, ...at }, own.intrinsics, own.width, own.height);
      const answer = { pixels: [...data], wide: renderer.wide };
      renderer.dispose();
      return answer;
    },
    [sent, mode, pose],
  );
  return { pixels: Uint8ClampedArray.from(pixels), wide };
}

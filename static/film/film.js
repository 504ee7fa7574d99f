// Makes a film of a 3D photo in the browser; nothing is uploaded.
//
//   const blob = await makeFilm(viewer, { kind: 'mp4', style: 'swing', seconds: 4, side: 1280 }, { signal, progress: (share) => … });

import { cameraAt, pathAt } from './camera-path.js';
import { planOf } from './plan.js';

/** @import { Viewer } from '../view/viewer.js' */
/** @import { FilmOptions, Plan } from './plan.js' */

/**
 * Encodes the frames of a film, in order, into a file.
 * @typedef {{add: (pixels: ImageData, atMs: number) => Promise<void>, finish: () => Promise<Blob>, close: () => void}} Writer
 */

/** @type {Record<string, (plan: Plan, sample: (share: number) => Promise<ImageData>) => Promise<Writer>>} */
const WRITERS = {
  mp4: async (plan) => (await import('./video.js')).videoWriter(plan, 'mp4'),
  webm: async (plan) => (await import('./video.js')).videoWriter(plan, 'webm'),
  gif: async (plan, sample) => (await import('./gif.js')).gifWriter(plan, sample),
};

/**
 * Makes a film. Throws an AbortError if cancelled, and an error if the browser does not draw or has no encoder.
 * @param {Viewer} viewer
 * @param {FilmOptions} options
 * @param {{signal?: AbortSignal, progress?: (share: number) => void}} [on] `progress`: 0 to 1
 * @returns {Promise<Blob>}
 */
export async function makeFilm(viewer, options, { signal, progress } = {}) {
  const { head, limits, pivot } = viewer;
  if (!viewer.renderer || !head || !limits) throw new Error('a film can be made only if the browser draws the scene');
  const plan = planOf(options, head);
  const frame = (/** @type {number} */ share) => draw(viewer, cameraAt({ head, limits, pivot }, pathAt(options.style, share), plan), plan);
  // pause the viewer meanwhile
  const { asleep } = viewer;
  viewer.asleep = true;
  /** @type {Writer | null} */
  let writer = null;
  try {
    writer = await WRITERS[options.kind](plan, frame);
    for (const [i, time] of plan.times.entries()) {
      signal?.throwIfAborted();
      await writer.add(await frame((time * plan.turns) % 1), i * plan.frameMs);
      progress?.((i + 1) / plan.times.length);
    }
    signal?.throwIfAborted();
    return await writer.finish();
  } finally {
    writer?.close();
    viewer.asleep = asleep;
  }
}

/**
 * @param {Viewer} viewer
 * @param {ReturnType<typeof cameraAt>} camera
 * @param {Plan} plan
 */
async function draw({ renderer }, { pose, k }, { width, height }) {
  if (!renderer || renderer.disposed) throw new Error('the graphics device is lost');
  const { overlay } = renderer;
  renderer.overlay = 0;
  const reading = renderer.readPixels(pose, k, width, height);
  // the draw calls are already submitted; only reading back is asynchronous
  renderer.overlay = overlay;
  const pixels = await reading;
  // colours are premultiplied, so uncovered pixels become black
  for (let i = 3; i < pixels.length; i += 4) pixels[i] = 255;
  return new ImageData(pixels, width, height);
}

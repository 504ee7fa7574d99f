// Films by WebCodecs: H.264 in MP4.

/** @import { Plan } from './plan.js' */
/** @import { Writer } from './film.js' */

/** Bits a pixel and frame: photos that move slowly need no more. */
const BITS = 0.14;
const LEAST_BITRATE = 600_000;
/** Frames from one that needs no other to the next. */
const KEY_EVERY = 60;
/** Frames that wait to be coded, at most. */
const WAITING = 4;

/** Levels of H.264 by the macroblocks that a frame has at most (ITU-T H.264, table A-1). */
const LEVELS = [
  { blocks: 3600, name: '1f' },
  { blocks: 8192, name: '28' },
  { blocks: 36_864, name: '33' },
];
/** High, Main, Baseline. */
const PROFILES = ['6400', '4d00', '4200'];

/**
 * Names of the codec, the best first.
 * @param {{width: number, height: number}} size
 */
function codecs({ width, height }) {
  const blocks = Math.ceil(width / 16) * Math.ceil(height / 16);
  const level = (LEVELS.find((l) => blocks <= l.blocks) ?? LEVELS[LEVELS.length - 1]).name;
  return PROFILES.map((profile) => `avc1.${profile}${level}`);
}

/**
 * The encoder's configuration, or null where this browser has none.
 * @param {{width: number, height: number, frameMs: number}} film
 */
export async function encoding({ width, height, frameMs }) {
  if (typeof VideoEncoder === 'undefined') return null;
  const framerate = 1000 / frameMs;
  const bitrate = Math.round(Math.max(LEAST_BITRATE, width * height * Math.max(framerate, 24) * BITS));
  for (const codec of codecs({ width, height })) {
    /** @type {VideoEncoderConfig} */
    const config = { codec, width, height, bitrate, framerate, latencyMode: 'quality', avc: { format: 'avc' } };
    const answer = await VideoEncoder.isConfigSupported(config).catch(() => null);
    if (answer?.supported) return config;
  }
  return null;
}

/**
 * @param {Plan} plan
 * @returns {Promise<Writer>}
 */
export async function videoWriter(plan) {
  const { width, height, frameMs } = plan;
  const config = await encoding(plan);
  if (!config) throw new Error('This browser has no encoder for such films.');
  const { Muxer, ArrayBufferTarget } = await import(new URL('../vendor/mp4-muxer.mjs', import.meta.url).href);
  const target = new ArrayBufferTarget();
  const muxer = new Muxer({ target, video: { codec: 'avc', width, height }, fastStart: 'in-memory' });
  /** @type {Error | null} */
  let failed = null;
  let wake = () => {};
  const encoder = new VideoEncoder({
    output: (chunk, meta) => muxer.addVideoChunk(chunk, meta),
    error: (error) => {
      failed = error;
      wake();
    },
  });
  encoder.configure(config);
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext('2d');
  let count = 0;
  return {
    async add(pixels, atMs) {
      context?.putImageData(pixels, 0, 0);
      const frame = new VideoFrame(canvas, { timestamp: Math.round(atMs * 1000), duration: Math.round(frameMs * 1000) });
      encoder.encode(frame, { keyFrame: count++ % KEY_EVERY === 0 });
      frame.close();
      while (encoder.encodeQueueSize > WAITING && !failed) {
        await new Promise((/** @type {(value?: any) => void} */ resume) => {
          wake = resume;
          encoder.addEventListener('dequeue', resume, { once: true });
        });
      }
      if (failed) throw failed;
    },
    async finish() {
      await encoder.flush();
      if (failed) throw failed;
      muxer.finalize();
      return new Blob([target.buffer], { type: 'video/mp4' });
    },
    close() {
      if (encoder.state !== 'closed') encoder.close();
    },
  };
}

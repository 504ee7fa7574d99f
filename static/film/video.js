// Films by WebCodecs: H.264 in MP4, which plays everywhere, or VP9 or AV1 in WebM if the browser has no H.264 encoder.

/** @import { Plan } from './plan.js' */
/** @typedef {'mp4' | 'webm'} Container */
/** @import { Writer } from './film.js' */

/** Bits per pixel and frame; enough for the slow motion of these films. */
const BITS_PER_PIXEL = 0.14;
const MIN_BITRATE = 600_000;
/** Key frame interval, frames. */
const KEY_INTERVAL = 60;
/** Most frames in the encoder's queue. */
const MAX_QUEUE = 4;

/** Levels of H.264, by the largest number of macroblocks in a frame (ITU-T H.264, table A-1). */
const LEVELS = [
  { blocks: 3600, name: '1f' },
  { blocks: 8192, name: '28' },
  { blocks: 36_864, name: '33' },
];
/** High, Main, Baseline. */
const PROFILES = ['6400', '4d00', '4200'];

/**
 * WebM codec strings, in order of preference, and the muxer's names: profile 0, 8 bits, levels for 1080 and for 2160 lines (VP9 bitstream
 * specification, annex A; AV1, annex A.3). VP9 comes first because AV1 software encoders are many times slower.
 * @type {[string, string][]}
 */
const WEBM_CODECS = [
  ['vp09.00.40.08', 'V_VP9'],
  ['vp09.00.51.08', 'V_VP9'],
  ['av01.0.08M.08', 'V_AV1'],
  ['av01.0.12M.08', 'V_AV1'],
];

/**
 * H.264 codec strings, in order of preference, and the muxer's name.
 * @param {{width: number, height: number}} size
 * @returns {[string, string][]}
 */
function h264Codecs({ width, height }) {
  const blocks = Math.ceil(width / 16) * Math.ceil(height / 16);
  const level = (LEVELS.find((l) => blocks <= l.blocks) ?? LEVELS[LEVELS.length - 1]).name;
  return PROFILES.map((profile) => [`avc1.${profile}${level}`, 'avc']);
}

/**
 * The encoder configuration and the muxer's name of its codec, or null if the browser has no encoder.
 * @param {{width: number, height: number, frameMs: number}} film
 * @param {Container} container
 * @returns {Promise<{config: VideoEncoderConfig, name: string} | null>}
 */
export async function encoding({ width, height, frameMs }, container) {
  if (typeof VideoEncoder === 'undefined') return null;
  const framerate = 1000 / frameMs;
  const bitrate = Math.round(Math.max(MIN_BITRATE, width * height * Math.max(framerate, 24) * BITS_PER_PIXEL));
  for (const [codec, name] of container === 'mp4' ? h264Codecs({ width, height }) : WEBM_CODECS) {
    /** @type {VideoEncoderConfig} */
    const config = { codec, width, height, bitrate, framerate, latencyMode: 'quality' };
    if (container === 'mp4') config.avc = { format: 'avc' };
    const result = await VideoEncoder.isConfigSupported(config).catch(() => null);
    if (result?.supported) return { config, name };
  }
  return null;
}

/**
 * The muxer for a container. Both muxers take times in microseconds.
 * @param {Container} container
 * @param {{width: number, height: number, frameMs: number}} film
 * @param {string} name of the codec
 */
async function muxerOf(container, { width, height, frameMs }, name) {
  const { Muxer, ArrayBufferTarget } = await import(new URL(`../vendor/${container}-muxer.mjs`, import.meta.url).href);
  const target = new ArrayBufferTarget();
  const video = { codec: name, width, height };
  const muxer =
    container === 'mp4'
      ? new Muxer({ target, video, fastStart: 'in-memory' })
      : new Muxer({ target, video: { ...video, frameRate: 1000 / frameMs }, type: 'webm' });
  return { muxer, target };
}

/**
 * @param {Plan} plan
 * @param {Container} container
 * @returns {Promise<Writer>}
 */
export async function videoWriter(plan, container) {
  const { width, height, frameMs } = plan;
  const supported = await encoding(plan, container);
  if (!supported) throw new Error('This browser has no encoder for such films.');
  const { muxer, target } = await muxerOf(container, plan, supported.name);
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
  encoder.configure(supported.config);
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext('2d');
  let count = 0;
  return {
    async add(pixels, atMs) {
      context?.putImageData(pixels, 0, 0);
      const frame = new VideoFrame(canvas, { timestamp: Math.round(atMs * 1000), duration: Math.round(frameMs * 1000) });
      encoder.encode(frame, { keyFrame: count++ % KEY_INTERVAL === 0 });
      frame.close();
      while (encoder.encodeQueueSize > MAX_QUEUE && !failed) {
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
      return new Blob([target.buffer], { type: `video/${container}` });
    },
    close() {
      if (encoder.state !== 'closed') encoder.close();
    },
  };
}

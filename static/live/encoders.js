// Encodes frames as video with the browser's encoders, or as JPEG files if it has none.

import { pictureOf } from './camera-frames.js';
import { JPEG } from './frame-decoder.js';

/** @import { Frame } from './camera-frames.js' */

/**
 * An encoded frame; `time` in µs, `layer` its temporal layer.
 * @typedef {{time: number, key: boolean, layer: number, data: Uint8Array<ArrayBuffer>}} Coded
 */
/**
 * `busy`: count of frames being encoded; `encode` closes the frame.
 * @typedef {{codec: string, busy: number, encode: (frame: Frame, time: number, key: boolean) => void, close: () => void}} Encoder
 */

/** Codecs in order of preference; the server refuses those that it cannot decode. */
const CODECS = [
  // baseline, level 3.1: every machine decodes it, and unchanged parts of the picture stay bit-identical
  { codec: 'avc1.42E01F', avc: /** @type {AvcEncoderConfig} */ ({ format: 'annexb' }) },
  { codec: 'vp09.00.10.08' },
];
/** Two temporal layers: no frame refers to the upper one, so the server can drop it for viewers that fall behind. */
const SCALABILITY_MODE = 'L1T2';
/** Bits per pixel and second: 384 kbit/s at 320×240, as in `tmpi-lab live-bench`, where that gives 39 dB. */
const BITS_PER_PX = 5;
const JPEG_QUALITY = 0.8;
/** Target frames per second. */
export const RATE = 30;

/**
 * Codecs that this browser can encode at a size, best first, each with temporal layers before without; JPEG last.
 * @param {{width: number, height: number}} size
 * @returns {Promise<(VideoEncoderConfig | {codec: string})[]>}
 */
export async function codecsFor({ width, height }) {
  const found = [];
  for (const codec of globalThis.VideoEncoder ? CODECS : []) {
    /** @type {VideoEncoderConfig} */
    const plain = { ...codec, width, height, framerate: RATE, bitrate: Math.round(BITS_PER_PX * width * height), latencyMode: 'realtime' };
    for (const config of [{ ...plain, scalabilityMode: SCALABILITY_MODE }, plain]) {
      const { supported } = await VideoEncoder.isConfigSupported(config).catch(() => ({ supported: false }));
      if (supported) found.push(config);
    }
  }
  return [...found, { codec: JPEG }];
}

/**
 * @param {VideoEncoderConfig | {codec: string}} config of `codecsFor`
 * @param {(coded: Coded) => void} done
 * @param {(error: Error) => void} failed
 * @returns {Encoder}
 */
export function encoderOf(config, done, failed) {
  return 'width' in config ? new BrowserEncoder(config, done, failed) : new JpegEncoder(done, failed);
}

/**
 * The encoder's metadata on layers, empty if it reports none.
 * @param {EncodedVideoChunkMetadata | undefined} metadata
 * @returns {{temporalLayerId?: number}}
 */
function svcMetadata(metadata) {
  return /** @type {any} */ (metadata)?.svc ?? {};
}

class BrowserEncoder {
  #encoder;
  /** @type {number[]} */
  #pending = [];
  /** @type {OffscreenCanvas | null} */
  #canvas = null;

  /**
   * @param {VideoEncoderConfig} config
   * @param {(coded: Coded) => void} done
   * @param {(error: Error) => void} failed
   */
  constructor(config, done, failed) {
    this.codec = config.codec;
    this.#encoder = new VideoEncoder({
      output: (chunk, metadata) => {
        // an encoder may drop frames
        this.#pending = this.#pending.filter((time) => time > chunk.timestamp);
        const data = new Uint8Array(chunk.byteLength);
        chunk.copyTo(data);
        const { temporalLayerId: layer = 0 } = svcMetadata(metadata);
        done({ time: chunk.timestamp, key: chunk.type === 'key', layer, data });
      },
      error: failed,
    });
    this.#encoder.configure(config);
  }

  get busy() {
    return this.#pending.length;
  }

  /**
   * @param {Frame} frame
   * @param {number} time
   * @param {boolean} key
   */
  encode(frame, time, key) {
    const timed = new VideoFrame(this.#upright(frame), { timestamp: time });
    frame.close();
    this.#pending.push(time);
    this.#encoder.encode(timed, { keyFrame: key });
    timed.close();
  }

  /**
   * The picture of a frame, upright: encoders ignore the rotation that a camera reports.
   * @param {Frame} frame
   * @returns {CanvasImageSource}
   */
  #upright(frame) {
    const picture = pictureOf(frame);
    const { rotation = 0, flip = false } = /** @type {{rotation?: number, flip?: boolean}} */ (picture);
    if (!rotation && !flip) return picture;
    const { displayWidth: width, displayHeight: height } = frame;
    if (this.#canvas?.width !== width || this.#canvas.height !== height) this.#canvas = new OffscreenCanvas(width, height);
    this.#canvas.getContext('2d')?.drawImage(picture, 0, 0, width, height);
    return this.#canvas;
  }

  close() {
    if (this.#encoder.state !== 'closed') this.#encoder.close();
  }
}

class JpegEncoder {
  codec = JPEG;
  busy = 0;
  #done;
  #failed;
  /** @type {OffscreenCanvas | null} */
  #canvas = null;
  #closed = false;

  /**
   * @param {(coded: Coded) => void} done
   * @param {(error: Error) => void} failed
   */
  constructor(done, failed) {
    this.#done = done;
    this.#failed = failed;
  }

  /**
   * @param {Frame} frame
   * @param {number} time
   */
  async encode(frame, time) {
    this.busy++;
    try {
      this.#canvas ??= new OffscreenCanvas(frame.displayWidth, frame.displayHeight);
      this.#canvas.getContext('2d')?.drawImage(pictureOf(frame), 0, 0, this.#canvas.width, this.#canvas.height);
      frame.close();
      const file = await this.#canvas.convertToBlob({ type: 'image/jpeg', quality: JPEG_QUALITY });
      if (!this.#closed) this.#done({ time, key: true, layer: 0, data: new Uint8Array(await file.arrayBuffer()) });
    } catch (error) {
      this.#failed(error);
    } finally {
      this.busy--;
    }
  }

  close() {
    this.#closed = true;
  }
}

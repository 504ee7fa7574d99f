// What makes video of frames: the browser's encoders, or JPEG files where it has none.

import { pictureOf } from './frames.js';
import { JPEG } from './pictures.js';

/** @import { Frame } from './frames.js' */

/** @typedef {{time: number, key: boolean, layer: number, data: Uint8Array<ArrayBuffer>}} Coded a frame as it is sent; time in µs, its temporal layer */
/** @typedef {{codec: string, busy: number, encode: (frame: Frame, time: number, key: boolean) => void, close: () => void}} Encoder `busy`: frames under way; `encode` closes the frame */

/** Codecs in the order in which they are tried; the server refuses those that it cannot decode. */
const CODECS = [
  // baseline, level 3.1: every machine decodes it, and unchanged parts of the picture stay the same bits
  { codec: 'avc1.42E01F', avc: /** @type {AvcEncoderConfig} */ ({ format: 'annexb' }) },
  { codec: 'vp09.00.10.08' },
];
/** Every other frame is one that no other refers to: who is behind is not sent those. */
const LAYERS = 'L1T2';
/** Bits a pixel and second: 384 kbit/s at 320×240, as `tmpi-lab live-bench` has it, where that is 39 dB. */
const BITS = 5;
const QUALITY = 0.8;
/** Frames a second that are aimed at. */
export const RATE = 30;

/**
 * Codecs that this browser encodes at a size, best first, each in temporal layers before it comes without; JPEG at last.
 * @param {{width: number, height: number}} size
 * @returns {Promise<(VideoEncoderConfig | {codec: string})[]>}
 */
export async function codecsFor({ width, height }) {
  const found = [];
  for (const codec of globalThis.VideoEncoder ? CODECS : []) {
    /** @type {VideoEncoderConfig} */
    const plain = { ...codec, width, height, framerate: RATE, bitrate: Math.round(BITS * width * height), latencyMode: 'realtime' };
    for (const config of [{ ...plain, scalabilityMode: LAYERS }, plain]) {
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
  return 'width' in config ? new Browser(config, done, failed) : new Jpeg(done, failed);
}

/**
 * What an encoder says of layers; nothing where it has none.
 * @param {EncodedVideoChunkMetadata | undefined} metadata
 * @returns {{temporalLayerId?: number}}
 */
function svcOf(metadata) {
  return /** @type {any} */ (metadata)?.svc ?? {};
}

class Browser {
  #encoder;
  /** @type {number[]} */
  #under = [];
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
        // an encoder may leave frames out
        this.#under = this.#under.filter((time) => time > chunk.timestamp);
        const data = new Uint8Array(chunk.byteLength);
        chunk.copyTo(data);
        const { temporalLayerId: layer = 0 } = svcOf(metadata);
        done({ time: chunk.timestamp, key: chunk.type === 'key', layer, data });
      },
      error: failed,
    });
    this.#encoder.configure(config);
  }

  get busy() {
    return this.#under.length;
  }

  /**
   * @param {Frame} frame
   * @param {number} time
   * @param {boolean} key
   */
  encode(frame, time, key) {
    const timed = new VideoFrame(this.#upright(frame), { timestamp: time });
    frame.close();
    this.#under.push(time);
    this.#encoder.encode(timed, { keyFrame: key });
    timed.close();
  }

  /**
   * What is drawn of a frame, upright: encoders pass over that a camera says how its picture is to be turned.
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

class Jpeg {
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
      const file = await this.#canvas.convertToBlob({ type: 'image/jpeg', quality: QUALITY });
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

// Decodes the frames of a room with the browser's decoders.

/** @import { Colour, Video } from './decoder.js' */

/** Codec string if each frame is a JPEG file. */
export const JPEG = 'jpeg';
/** The end marker of a JPEG. Cameras omit it, and browsers then reject the frame as truncated. A second one has no effect. */
const JPEG_END = new Uint8Array([0xff, 0xd9]);
/** Duration of a frame, µs. Without it, one browser considers its decoder too slow. */
const DURATION_US = 33_333;

/**
 * A frame's number, capture time (µs, publisher's clock), arrival time (ms) and visible part.
 * @typedef {{frame: number, time: number, arrived: number, shown?: DOMRectInit}} FrameInfo
 */
/** @typedef {FrameInfo & {picture: VideoFrame | ImageBitmap, ms: number}} Decoded `ms`: decoding time */

/**
 * Crops a picture to its visible part if the browser has not: Chromium's software H.264 decoder starts at the first row and column.
 * @param {VideoFrame} picture
 * @param {DOMRectInit} [shown]
 */
function cropped(picture, shown = {}) {
  const { visibleRect: seen, codedWidth, codedHeight, timestamp } = picture;
  const { x = 0, y = 0, width = 0, height = 0 } = shown;
  if (!seen || seen.x || seen.y || (!x && !y) || x + width > codedWidth || y + height > codedHeight) return picture;
  const part = new VideoFrame(picture, { visibleRect: shown, timestamp, displayWidth: width, displayHeight: height });
  picture.close();
  return part;
}

/** The browser cannot decode the video. */
export class NoDecoder extends Error {}

export class FrameDecoder {
  #codec;
  #done;
  #failed;
  /** @type {VideoDecoder | null} */
  #decoder = null;
  /** @type {Map<number, FrameInfo & {began: number}>} */
  #pending = new Map();
  #closed = false;
  /** The colours that the decoder is configured for, as JSON. */
  #colour = '';

  /**
   * @param {string} codec
   * @param {(decoded: Decoded) => void} done called in order; it must close the picture
   * @param {(error: Error) => void} failed called on an error; no picture follows
   * @throws {NoDecoder}
   */
  static async of(codec, done, failed) {
    if (codec !== JPEG) {
      if (!globalThis.VideoDecoder) throw new NoDecoder('This browser cannot decode video.');
      const { supported } = await VideoDecoder.isConfigSupported({ codec }).catch(() => ({ supported: false }));
      if (!supported) throw new NoDecoder('This browser cannot decode video.');
    }
    return new FrameDecoder(codec, done, failed);
  }

  /**
   * @param {string} codec
   * @param {(decoded: Decoded) => void} done
   * @param {(error: Error) => void} failed
   */
  constructor(codec, done, failed) {
    this.#codec = codec;
    this.#done = done;
    this.#failed = failed;
    if (codec === JPEG) return;
    this.#decoder = new VideoDecoder({
      output: (picture) => {
        const info = this.#pending.get(picture.timestamp);
        if (!info || this.#closed) return picture.close();
        this.#pending.delete(picture.timestamp);
        done({ ...info, picture: cropped(picture, info.shown), ms: performance.now() - info.began });
      },
      error: (error) => this.#fail(error),
    });
    this.#configure();
  }

  /**
   * Some browsers read the colours only from this configuration; others assume BT.709 without it.
   * @param {Colour} [colour] of the frames that follow
   */
  #configure(colour) {
    const json = JSON.stringify(colour) ?? '';
    if (json === this.#colour && this.#decoder?.state === 'configured') return;
    this.#colour = json;
    const colorSpace = /** @type {any} */ (colour && { primaries: 'bt709', transfer: 'bt709', ...colour });
    this.#decoder?.configure({ codec: this.#codec, optimizeForLatency: true, ...(colorSpace && { colorSpace }) });
  }

  /**
   * @param {Video} video
   * @param {number} arrived
   */
  decode({ frame, time, key, colour, shown, data }, arrived) {
    const info = { frame, time, arrived, shown, began: performance.now() };
    if (!this.#decoder) {
      this.#jpeg(data, info);
      return;
    }
    // forget frames that the decoder dropped
    for (const [at, { frame: old }] of this.#pending) if (old < frame - 120) this.#pending.delete(at);
    this.#pending.set(frame, info);
    try {
      if (key) this.#configure(colour);
      this.#decoder.decode(new EncodedVideoChunk({ type: key ? 'key' : 'delta', timestamp: frame, duration: DURATION_US, data }));
    } catch (error) {
      this.#fail(error);
    }
  }

  #jpegQueue = Promise.resolve();
  #jpegCount = 0;

  /**
   * @param {Uint8Array<ArrayBuffer>} data
   * @param {FrameInfo & {began: number}} info
   */
  #jpeg(data, info) {
    const newest = ++this.#jpegCount;
    this.#jpegQueue = this.#jpegQueue.then(async () => {
      // JPEG frames are independent, so only the newest is decoded
      if (this.#closed || newest !== this.#jpegCount) return;
      try {
        const picture = await createImageBitmap(new Blob([data, JPEG_END], { type: 'image/jpeg' }), { colorSpaceConversion: 'none' });
        if (this.#closed) return picture.close();
        this.#done({ ...info, picture, ms: performance.now() - info.began });
      } catch (error) {
        this.#fail(error);
      }
    });
  }

  /** @param {Error} error */
  #fail(error) {
    if (this.#closed) return;
    this.close();
    this.#failed(new Error(`${this.#codec}: ${error.message}`));
  }

  close() {
    if (this.#closed) return;
    this.#closed = true;
    if (this.#decoder && this.#decoder.state !== 'closed') this.#decoder.close();
  }
}

// Decodes the frames of a room by the browser's own decoders.

/** @import { Colour, Video } from './decoder.js' */

/** Codec string of frames that are JPEG files. */
export const JPEG = 'jpeg';
/** The end marker of a JPEG. Cameras leave it out, and then browsers take the frame for one that is cut short; behind another it is nothing. */
const END = new Uint8Array([0xff, 0xd9]);
/** Without a duration one browser takes its decoder for too slow, µs. */
const DURATION = 33_333;

/** @typedef {{frame: number, time: number, arrived: number}} Taken a frame's number, when it was taken (µs, the publisher's clock) and when it came (ms) */
/** @typedef {Taken & {picture: VideoFrame | ImageBitmap, ms: number}} Decoded and how long decoding took */

/** Why a browser shows no video. */
export class NoDecoder extends Error {}

export class Pictures {
  #codec;
  #done;
  #failed;
  /** @type {VideoDecoder | null} */
  #decoder = null;
  /** @type {Map<number, Taken & {began: number}>} */
  #under = new Map();
  #closed = false;
  /** As the decoder was told last, as text. */
  #colour = '';

  /**
   * @param {string} codec
   * @param {(decoded: Decoded) => void} done called in order; whoever gets a picture closes it
   * @param {(error: Error) => void} failed nothing more comes then
   * @throws {NoDecoder}
   */
  static async of(codec, done, failed) {
    if (codec !== JPEG) {
      if (!globalThis.VideoDecoder) throw new NoDecoder('This browser cannot decode video.');
      const { supported } = await VideoDecoder.isConfigSupported({ codec }).catch(() => ({ supported: false }));
      if (!supported) throw new NoDecoder('This browser cannot decode video.');
    }
    return new Pictures(codec, done, failed);
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
        const taken = this.#under.get(picture.timestamp);
        if (!taken || this.#closed) return picture.close();
        this.#under.delete(picture.timestamp);
        done({ ...taken, picture, ms: performance.now() - taken.began });
      },
      error: (error) => this.#fail(error),
    });
    this.#configure();
  }

  /**
   * Some browsers take colours from here alone, and others that they have not been told for BT.709.
   * @param {Colour} [colour] of the frames that follow
   */
  #configure(colour) {
    const told = JSON.stringify(colour) ?? '';
    if (told === this.#colour && this.#decoder?.state === 'configured') return;
    this.#colour = told;
    const colorSpace = /** @type {any} */ (colour && { primaries: 'bt709', transfer: 'bt709', ...colour });
    this.#decoder?.configure({ codec: this.#codec, optimizeForLatency: true, ...(colorSpace && { colorSpace }) });
  }

  /**
   * @param {Video} video
   * @param {number} arrived
   */
  decode({ frame, time, key, colour, data }, arrived) {
    const taken = { frame, time, arrived, began: performance.now() };
    if (!this.#decoder) {
      this.#jpeg(data, taken);
      return;
    }
    // what never came out is forgotten
    for (const [at, { frame: old }] of this.#under) if (old < frame - 120) this.#under.delete(at);
    this.#under.set(frame, taken);
    try {
      if (key) this.#configure(colour);
      this.#decoder.decode(new EncodedVideoChunk({ type: key ? 'key' : 'delta', timestamp: frame, duration: DURATION, data }));
    } catch (error) {
      this.#fail(error);
    }
  }

  #last = Promise.resolve();
  #waiting = 0;

  /**
   * @param {Uint8Array<ArrayBuffer>} data
   * @param {Taken & {began: number}} taken
   */
  #jpeg(data, taken) {
    const newest = ++this.#waiting;
    this.#last = this.#last.then(async () => {
      // each needs no other, so the newest is enough
      if (this.#closed || newest !== this.#waiting) return;
      try {
        const picture = await createImageBitmap(new Blob([data, END], { type: 'image/jpeg' }), { colorSpaceConversion: 'none' });
        if (this.#closed) return picture.close();
        this.#done({ ...taken, picture, ms: performance.now() - taken.began });
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

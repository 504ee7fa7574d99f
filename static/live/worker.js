// Watches a room in a worker: receives its messages, decodes the video, and composes the layers of its tiles.
//
// Messages from the page: {watch: {address, token, side, flat}} starts · {drawn, scratch}: a picture is shown, and `scratch` is a buffer to reuse ·
// {again}: send the whole scene again · {hidden} · {sound}: whether the sound is on · {flat}: nothing can draw the scene.
// Messages to the page: {type: 'head', head} · {type: 'scene', scene, cells} · {type: 'update', instances, cells} ·
// {type: 'picture', picture, early}: plain video, `early` if it is only shown until the tiles arrive · {type: 'state', state, reason} ·
// {type: 'statistics', …} · {type: 'sound', …} · {type: 'has-sound', on} · {type: 'error', message}.

import { Connection, EVERYTHING, SOUND_ALONE } from './connection.js';
import { compiled, RoomDecoder } from './decoder.js';
import { FrameDecoder, NoDecoder } from './frame-decoder.js';
import { InFlight } from './in-flight.js';
import { Jitter } from './jitter.js';
import { Measurements } from './measurements.js';
import { PictureReader } from './pixels.js';
import { PlayoutBuffer } from './playout-buffer.js';
import { SoundDecoder } from './sound-decoder.js';
import { TileAtlas } from './tile-atlas.js';
import { TileSync } from './tile-sync.js';
// indirect imports, listed so that the browser fetches all modules at once
import '../decode/grid.js';
import '../decode/head.js';
import '../decode/wasm-instance.js';
import '../decode/module.js';
import '../draw/border.js';
import '../draw/instances.js';
import '../view/camera.js';
import '../view/camera-limits.js';

/** @import { SceneHead } from '../decode/scene.js' */
/** @import { Hello, Message, Statistics, Tiles, Video } from './decoder.js' */
/** @import { Decoded } from './frame-decoder.js' */

/**
 * `side`: of the largest texture; `flat`: nothing can draw the scene.
 * @typedef {{address: string, token: string, side: number, flat: boolean}} WatchRequest
 */

/** Time without a frame after which the state is `stalled`, ms. */
const STALLED_MS = 3000;
/** Time without an answer after which the page gets the whole scene again, ms. */
const UNANSWERED_MS = 4000;
/** Interval of statistics messages, ms. */
const STATISTICS_MS = 500;
/** Time after the first frame after which plain video is shown until every tile has arrived, ms. */
const FLAT_AFTER_MS = 1500;
/** First byte of GEOMETRY and SNAPSHOT (protobuf fields 3 and 4). */
const TILE_MESSAGES = [(3 << 3) | 2, (4 << 3) | 2];
/** Watching ends after this many consecutive failed frames, each on a new connection, over at least this time, ms. */
const MAX_FAILURES = 4;
const MIN_FAILING_MS = 5000;
/** Time without a decoded picture, although frames arrive, after which watching ends, ms. */
const NO_PICTURE_MS = 10_000;

class Room {
  #decoder;
  #request;
  #connection;
  /** @type {Hello | null} */
  #hello = null;
  /** @type {FrameDecoder | null} */
  #frameDecoder = null;
  /** @type {TileAtlas | null} */
  #atlas = null;
  /** True if the page has the atlas's scene. */
  #sceneSent = false;
  /** @type {Decoded | null} */
  #next = null;
  #tileSync = new TileSync();
  #jitter = new Jitter();
  /** Frames that are not due yet, and the tiles behind them. @type {PlayoutBuffer<() => void>} */
  #playout = new PlayoutBuffer((done) => done());
  /** Deadline of the next frame: a frame that replaces a waiting one keeps its deadline. */
  #deadline = Infinity;
  #busy = false;
  #inFlight = new InFlight();
  /** Buffer to reuse for the next texels. @type {ArrayBuffer | undefined} */
  #scratch;
  #pictures = new PictureReader();
  #hidden = false;
  /** True if tiles arrived after their frame was shown. */
  #lateTiles = false;
  /** True to drop frames until the next key frame. */
  #needsKey = true;
  #lastFrame = 0;
  /** Time of the first frame with missing tiles, ms; 0 if none are missing. */
  #tilesMissingSince = 0;
  /** @type {Decoded | null} */
  #shown = null;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #timer;
  /** The last frame counted in the statistics. */
  #counted = -1;
  #measurements = new Measurements();
  /** @type {Statistics | null} */
  #statistics = null;
  #state = '';
  #reason = '';
  /** Consecutive frames that could not be decoded. */
  #failures = 0;
  /** Time of the first of them, ms. */
  #failingSince = 0;
  /** Last time that a frame was decoded or none was expected, ms. */
  #lastPicture = 0;
  #sound = new SoundDecoder();

  /**
   * @param {RoomDecoder} decoder
   * @param {WatchRequest} request
   */
  constructor(decoder, request) {
    this.#decoder = decoder;
    this.#request = request;
    this.#connection = new Connection(request, {
      message: (bytes) => this.#receive(bytes),
      state: (state, reason) => this.#setState(state === 'waiting' && (this.#hello || reason) ? 'ended' : state, reason),
    });
    this.#setState('connecting');
    this.#connection.start();
    setInterval(() => this.#reportStatistics(), STATISTICS_MS);
  }

  /** @param {boolean} wanted */
  set sound(wanted) {
    this.#sound.wanted = wanted;
  }

  /** @param {boolean} hidden */
  set hidden(hidden) {
    if (this.#hidden === hidden) return;
    this.#hidden = hidden;
    this.#needsKey = true;
    this.#drop();
    this.#deadline = Infinity;
    this.#lastFrame = this.#lastPicture = performance.now();
    // the server does not send these tiles again
    this.#playout.flush();
    this.#jitter = new Jitter();
    // the server repeats the last group of frames, so only the sound must continue meanwhile
    if (this.#sound.wanted && this.#connection.send(hidden ? SOUND_ALONE : EVERYTHING)) return;
    if (!hidden) this.#connection.start();
    else if (!this.#sound.wanted) this.#connection.stop();
  }

  /**
   * Handles the page's notice that it shows the oldest picture in flight.
   * @param {ArrayBuffer} [scratch] buffer that it no longer needs
   */
  drawn(scratch) {
    this.#scratch = scratch;
    const shown = this.#inFlight.shown(performance.now());
    if (shown) this.#measurements.shown(shown.time);
    this.#pump();
  }

  /** Switches to plain video. */
  flat() {
    this.#request.flat = true;
    this.#inFlight.clear();
    this.#pump();
  }

  /** Sends the whole scene again. */
  again() {
    this.#sceneSent = false;
    this.#inFlight.clear();
    this.#lateTiles = true;
    this.#pump();
  }

  /**
   * @param {string} state
   * @param {string} [reason]
   */
  #setState(state, reason = '') {
    // keep the reason of a state until the state or the reason changes
    if (state === this.#state && (!reason || reason === this.#reason)) return;
    [this.#state, this.#reason] = [state, reason];
    postMessage({ type: 'state', state, reason });
  }

  /** @param {Uint8Array<ArrayBuffer>} bytes */
  #receive(bytes) {
    this.#measurements.bytes += bytes.length;
    // reading tiles applies them, so they must not overtake the frames before them
    if (!this.#playout.empty && TILE_MESSAGES.includes(bytes[0])) return this.#playout.push(() => this.#read(bytes), 0, true);
    this.#read(bytes);
  }

  /** @param {Uint8Array<ArrayBuffer>} bytes */
  #read(bytes) {
    /** @type {Message} */
    let message;
    try {
      message = this.#decoder.read(bytes);
    } catch (error) {
      console.error(error.message);
      // the next connection sends what was missed
      return this.#connection.start();
    }
    if (message.kind === 'hello') this.#onHello(message);
    else if (message.kind === 'video') this.#onVideo(message);
    else if (message.kind === 'tiles') this.#onTiles(message);
    else if (message.kind === 'sound') this.#sound.decode(message);
    else if (message.kind === 'statistics') this.#statistics = message;
    else if (message.kind === 'bye') {
      if (message.cause === 'full') return this.#connection.full();
      if (message.again) return this.#setState('ended', message.cause === 'rejected' ? message.reason : '');
      this.#connection.stop();
      this.#setState('away', message.reason);
    }
  }

  /** @param {Hello} hello */
  async #onHello(hello) {
    if (this.#hidden) this.#connection.send(SOUND_ALONE);
    const before = this.#hello;
    this.#hello = hello;
    if (before?.epoch !== hello.epoch) this.#failures = 0;
    this.#lastPicture = performance.now();
    this.#needsKey = true;
    [this.#tileSync, this.#jitter] = [new TileSync(), new Jitter()];
    this.#playout.clear();
    this.#deadline = Infinity;
    this.#measurements.begin();
    this.#frameDecoder?.close();
    this.#frameDecoder = null;
    this.#drop();
    this.#sound.begin(hello);
    if (!before || JSON.stringify(before.head) !== JSON.stringify(hello.head)) {
      [this.#atlas, this.#sceneSent, this.#shown, this.#tilesMissingSince] = [null, false, null, 0];
      postMessage({ type: 'head', head: hello.head });
    }
    const early = this.#early;
    early.length = 0;
    try {
      const frameDecoder = await FrameDecoder.of(
        hello.codec,
        (decoded) => this.#onDecoded(decoded),
        (error) => this.#fail(error),
      );
      if (this.#hello !== hello) return frameDecoder.close();
      this.#frameDecoder = frameDecoder;
      this.#connection.succeeded();
      for (const { video, arrived } of early.splice(0)) this.#decode(video, arrived);
    } catch (error) {
      if (!(error instanceof NoDecoder)) throw error;
      this.#connection.stop();
      this.#setState('unsupported');
    }
  }

  /**
   * Frames that arrive before the browser's decoder is ready.
   * @type {{video: Video, arrived: number}[]}
   */
  #early = [];

  /** @param {Video} video */
  #onVideo(video) {
    const arrived = performance.now();
    this.#lastFrame = arrived;
    this.#measurements.arrived(video.time, arrived);
    this.#setState('live');
    if (this.#hidden) return;
    const due = this.#jitter.arrived(video.time / 1000, performance.timeOrigin + arrived) - performance.timeOrigin;
    this.#playout.push(() => this.#play(video, Math.max(arrived, due)), due);
  }

  /**
   * @param {Video} video
   * @param {number} arrived arrival or due time, whichever is later
   */
  #play(video, arrived) {
    this.#tileSync.frameArrived(video.frame, arrived);
    if (this.#frameDecoder) this.#decode(video, arrived);
    else this.#early.push({ video, arrived });
  }

  /**
   * @param {Video} video
   * @param {number} arrived
   */
  #decode(video, arrived) {
    if (this.#needsKey && !video.key) return;
    this.#needsKey = false;
    this.#frameDecoder?.decode(video, arrived);
  }

  /**
   * Handles a frame that could not be decoded. The next connection starts with a key frame; watching ends if that fails repeatedly.
   * @param {Error} error
   */
  #fail(error) {
    console.warn(error.message);
    const now = performance.now();
    if (!this.#failures++) this.#failingSince = now;
    this.#lastPicture = now;
    if (this.#failures < MAX_FAILURES || now - this.#failingSince < MIN_FAILING_MS) this.#connection.start();
    else this.#endUnsupported(error.message);
  }

  /** @param {string} reason why the browser cannot show the room */
  #endUnsupported(reason) {
    this.#connection.stop();
    this.#setState('unsupported', reason);
  }

  /** @param {Tiles} tiles */
  #onTiles({ frame, changed }) {
    this.#tileSync.tilesArrived(frame, performance.now());
    // those of a later frame are shown with it
    this.#lateTiles ||= changed > 0;
    this.#pump();
  }

  /** @param {Decoded} decoded */
  #onDecoded(decoded) {
    this.#lastPicture = performance.now();
    this.#measurements.took('video', decoded.ms);
    // a newer frame is ready, so show the one that waits for its tiles
    if (this.#next && !this.#busy && this.#canSend && !this.#hidden) {
      this.#deadline = 0;
      this.#pump();
    }
    this.#skip();
    this.#next = decoded;
    this.#pump();
  }

  /** Whether another picture may be sent to the page. */
  get #canSend() {
    return this.#request.flat ? this.#inFlight.empty : this.#inFlight.canSend(this.#tileSync.interval);
  }

  /** Drops the waiting frame. */
  #drop() {
    this.#next?.picture.close();
    this.#next = null;
  }

  /** Skips the waiting frame, because the newest one wins. The decoder remembers it for its tiles, which arrive later. */
  async #skip() {
    const [skipped, head] = [this.#next, this.#hello?.head];
    if (!skipped || !head || !this.#atlas || this.#request.flat || this.#hidden || this.#pictures.full) return this.#drop();
    this.#next = null;
    try {
      const pixels = await this.#pictures.read(skipped.picture, head);
      if (pixels && this.#hello?.head === head) this.#decoder.frame(pixels.format, pixels.bytes, skipped);
    } catch (error) {
      if (this.#hello?.head === head) this.#fail(error);
    }
  }

  /** Shows the next frame once its tiles have arrived or its wait is over, and late tiles. */
  async #pump() {
    if (this.#busy || !this.#canSend || this.#hidden || !this.#hello) return;
    const next = this.#next;
    if (next && this.#request.flat) return this.#showFlat(next);
    if (this.#request.flat || (!next && !(this.#lateTiles && this.#shown))) return;
    const now = performance.now();
    if (next) this.#deadline = Math.min(this.#deadline, now + this.#tileSync.waitFor(next, now));
    const wait = next ? this.#deadline - now : this.#sceneSent ? this.#tileSync.lateTilesWait(now) : 0;
    clearTimeout(this.#timer);
    if (wait > 0) {
      this.#timer = setTimeout(() => this.#pump(), wait);
      return;
    }
    this.#busy = true;
    this.#lateTiles = false;
    this.#deadline = Infinity;
    const { head } = this.#hello;
    let started = performance.now();
    /** @type {VideoFrame | ImageBitmap | null} */
    let plain = null;
    try {
      if (next) {
        this.#next = null;
        plain = await this.#plainPicture(next);
        const pixels = await this.#pictures.read(next.picture, head);
        if (!pixels || this.#hello.head !== head) return;
        const { format, bytes } = pixels;
        this.#measurements.took('copy', performance.now() - started);
        started = performance.now();
        this.#decoder.frame(format, bytes, next);
        this.#failures = 0;
        this.#shown = next;
      }
      if (this.#compose(head, started)) this.#tilesMissingSince = 0;
      else if (plain) {
        this.#sendPicture(plain, true);
        plain = null;
      }
    } catch (error) {
      if (this.#hello.head === head) this.#fail(error);
    } finally {
      plain?.close();
      this.#busy = false;
      if (this.#next) this.#pump();
    }
  }

  /**
   * A copy of a frame's picture, to be shown as plain video if there are no layers yet.
   * @param {Decoded} of
   * @returns {Promise<VideoFrame | ImageBitmap | null>}
   */
  async #plainPicture({ picture }) {
    if (this.#atlas) return null;
    this.#tilesMissingSince ||= performance.now();
    if (performance.now() - this.#tilesMissingSince < FLAT_AFTER_MS) return null;
    return 'clone' in picture ? picture.clone() : createImageBitmap(picture);
  }

  /**
   * Sends the changes to the page; returns false if nothing can be shown because tiles are missing.
   * @param {SceneHead} head
   * @param {number} started
   */
  #compose(head, started) {
    const changed = this.#decoder.layers();
    if (!changed.length && this.#sceneSent) {
      // nothing changed: the picture on the screen is also this frame's
      this.#count();
      if (this.#shown) this.#measurements.shown(this.#shown.time);
      return true;
    }
    if (!changed.length && !this.#atlas) return false;
    this.#atlas ??= new TileAtlas(head, this.#request.side);
    let { numbers, places, reshaped, grown } = this.#atlas.change(changed);
    if (!this.#sceneSent) ({ numbers, places } = this.#atlas.all());
    const cells = { places, data: this.#decoder.cells(numbers, this.#atlas.borderColumns, this.#scratch) };
    this.#scratch = undefined;
    const drawn = reshaped || !this.#sceneSent ? this.#atlas.drawn() : null;
    const made = performance.now() - started;
    this.#measurements.took('made', made);
    this.#count();
    const whole = drawn !== null && (grown || !this.#sceneSent);
    this.#inFlight.sent(this.#shown, performance.now(), whole);
    const transfer = [cells.data.buffer, cells.places.buffer];
    if (whole) {
      this.#sceneSent = true;
      const atlas = { ...this.#atlas.size, pages: this.#atlas.pages, wide: false, strips: [] };
      self.postMessage({ type: 'scene', scene: { ...head, ...drawn, atlas, decodeMs: made }, cells }, { transfer });
    } else self.postMessage({ type: 'update', instances: drawn?.instances ?? null, cells }, { transfer });
    return true;
  }

  /** @param {Decoded} next */
  #showFlat(next) {
    this.#failures = 0;
    this.#next = null;
    this.#shown = next;
    this.#sendPicture(next.picture, false);
  }

  /**
   * Shows a picture as plain video.
   * @param {VideoFrame | ImageBitmap} picture
   * @param {boolean} early whether its tiles are still missing
   */
  #sendPicture(picture, early) {
    this.#inFlight.sent(this.#shown, performance.now(), true);
    this.#count();
    self.postMessage({ type: 'picture', picture, early }, { transfer: [picture] });
  }

  /** Counts a frame once, even if late tiles draw it again. */
  #count() {
    const frame = this.#shown?.frame ?? -1;
    if (frame !== this.#counted) this.#measurements.frames++;
    this.#counted = frame;
  }

  #reportStatistics() {
    const now = performance.now();
    if (this.#state === 'live' && !this.#hidden && now - this.#lastFrame > STALLED_MS) this.#setState('stalled');
    if (this.#needsKey || this.#hidden || this.#state !== 'live') this.#lastPicture = now;
    else if (now - this.#lastPicture > NO_PICTURE_MS) this.#endUnsupported('its decoder outputs no pictures');
    if (!this.#hidden && !this.#request.flat && this.#inFlight.age(now) > UNANSWERED_MS) this.again();
    const { viewers = 0, skipped = 0, geometryMs = 0 } = this.#statistics ?? {};
    const { jitter, delay: buffer } = this.#jitter;
    const frame = this.#shown?.frame ?? -1;
    postMessage({ type: 'statistics', frame, ...this.#measurements.since(STATISTICS_MS), jitter, buffer, viewers, skipped, geometryMs });
  }
}

/** @type {Promise<Room> | null} */
let room = null;

self.onmessage = async ({ data }) => {
  try {
    if (data.watch) room = compiled().then(async (module) => new Room(await RoomDecoder.of(module), data.watch));
    const now = await room;
    if (!now) return;
    if (data.drawn) now.drawn(data.scratch);
    if (data.again) now.again();
    if (data.flat) now.flat();
    if ('hidden' in data) now.hidden = data.hidden;
    if ('sound' in data) now.sound = data.sound;
  } catch (error) {
    console.error(error.message);
    postMessage({ type: 'error', message: error.message });
  }
};

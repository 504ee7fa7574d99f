// A room as it is watched, off the page's thread.
// In: {watch: {address, token, side, flat}} · {drawn, spare} the last picture is shown, and a buffer that nobody reads any more · {again} the whole scene once more · {hidden} ·
// {sound} whether sound is wanted · {flat} nothing can draw the scene. Out: {type: 'head', head} · {type: 'scene', scene, cells} · {type: 'update', instances, cells} ·
// {type: 'picture', picture, early} where it is to be flat, `early` as its tiles are not there yet · {type: 'state', state, reason} · {type: 'statistics', …} · {type: 'sound', …}.

import { Connection, EVERYTHING, SOUND_ALONE } from './connection.js';
import { compiled, RoomDecoder } from './decoder.js';
import { Hold } from './hold.js';
import { Jitter } from './jitter.js';
import { Measurements } from './measurements.js';
import { NoDecoder, Pictures } from './pictures.js';
import { pixelsOf } from './pixels.js';
import { PlayOut } from './play-out.js';
import { SoundDecoder } from './sound-decoder.js';
import { TileAtlas } from './tile-atlas.js';
import { UnderWay } from './under-way.js';
// what those import, named here so that all of it is fetched at once
import '../decode/grid.js';
import '../decode/head.js';
import '../decode/instance.js';
import '../decode/module.js';
import '../draw/border.js';
import '../draw/instances.js';
import '../view/camera.js';
import '../view/limits.js';

/** @import { SceneHead } from '../decode/scene.js' */
/** @import { Hello, Message, Statistics, Video } from './decoder.js' */
/** @import { Decoded } from './pictures.js' */

/** @typedef {{address: string, token: string, side: number, flat: boolean}} Watched the room, side of the largest texture, and whether only video can be shown */

/** Time without a frame after which the picture stands still, ms. */
const STALLED_MS = 3000;
/** Time after which a page that does not say that it shows what it was sent is sent all of it anew, ms. */
const UNSEEN_MS = 4000;
/** Pause between two messages of what is measured, ms. */
const TELL_MS = 500;
/** Time after the first frame from which on it is shown flat as long as not all tiles came, ms. */
const DEPTH_MS = 1500;
/** Longest that copying the samples of a frame may take, ms: a browser was seen that never ended it. */
const COPY_MS = 500;
/** What GEOMETRY and SNAPSHOT begin with (protobuf's fields 3 and 4). */
const TILES = [(3 << 3) | 2, (4 << 3) | 2];
/** Frames in a row of which no picture can be had, each on a connection of its own, and time that it has to go on, ms, before it is over. */
const FAILURES = 4;
const FAILING_MS = 5000;
/** Time in which frames come and the browser’s decoder gives no picture, ms: it gives none. */
const SILENT_MS = 10_000;

class Room {
  #decoder;
  #watched;
  #connection;
  /** @type {Hello | null} */
  #hello = null;
  /** @type {Pictures | null} */
  #pictures = null;
  /** @type {TileAtlas | null} */
  #atlas = null;
  /** The page has the scene that the atlas belongs to. */
  #told = false;
  /** @type {Decoded | null} */
  #next = null;
  #hold = new Hold();
  #jitter = new Jitter();
  /** Frames that came before their time, and the tiles behind them. @type {PlayOut<() => void>} */
  #playOut = new PlayOut((done) => done());
  /** When a frame is shown at the latest: one that takes the place of another that waited does not begin to wait anew. */
  #due = Infinity;
  #busy = false;
  #underWay = new UnderWay();
  /** For the next texels, that it need not be made anew. @type {ArrayBuffer | undefined} */
  #spare;
  /** Samples are copied as they are; else by way of a canvas. */
  #copies = true;
  #hidden = false;
  /** Tiles came after the frame that is shown. */
  #late = false;
  /** Frames are left out up to the next one that needs no other. */
  #waits = true;
  #lastFrame = 0;
  /** When the first frame came for which not all tiles are there; 0: they are, or there was none. */
  #depthless = 0;
  /** @type {Decoded | null} */
  #shown = null;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #timer;
  /** The frame that was counted last. */
  #counted = -1;
  #measurements = new Measurements();
  /** @type {Statistics | null} */
  #statistics = null;
  #state = '';
  #reason = '';
  /** Frames in a row of which no picture could be had. */
  #failures = 0;
  /** When the first of them was. */
  #failing = 0;
  /** When a frame was decoded last, or nobody waited for one. */
  #lastPicture = 0;
  #sound = new SoundDecoder();

  /**
   * @param {RoomDecoder} decoder
   * @param {Watched} watched
   */
  constructor(decoder, watched) {
    this.#decoder = decoder;
    this.#watched = watched;
    this.#connection = new Connection(watched, {
      message: (bytes) => this.#take(bytes),
      state: (state, reason) => this.#say(state === 'waiting' && (this.#hello || reason) ? 'ended' : state, reason),
    });
    this.#say('connecting');
    this.#connection.start();
    setInterval(() => this.#tell(), TELL_MS);
  }

  /** @param {boolean} wanted */
  set sound(wanted) {
    this.#sound.wanted = wanted;
  }

  /** @param {boolean} hidden */
  set hidden(hidden) {
    if (this.#hidden === hidden) return;
    this.#hidden = hidden;
    this.#waits = true;
    this.#drop();
    this.#due = Infinity;
    this.#lastFrame = this.#lastPicture = performance.now();
    // tiles that came are not sent again
    this.#playOut.hurry();
    this.#jitter = new Jitter();
    // the last group of frames comes anew, so nothing need be kept up meanwhile but the sound
    if (this.#sound.wanted && this.#connection.send(hidden ? SOUND_ALONE : EVERYTHING)) return;
    if (!hidden) this.#connection.start();
    else if (!this.#sound.wanted) this.#connection.stop();
  }

  /**
   * The page shows the first of what it was sent.
   * @param {ArrayBuffer} [spare] that it has read
   */
  drawn(spare) {
    this.#spare = spare;
    const shown = this.#underWay.shown(performance.now());
    if (shown) this.#measurements.shown(shown.time);
    this.#pump();
  }

  /** Plain video from now on. */
  flat() {
    this.#watched.flat = true;
    this.#underWay.clear();
    this.#pump();
  }

  /** The whole scene once more. */
  again() {
    this.#told = false;
    this.#underWay.clear();
    this.#late = true;
    this.#pump();
  }

  /**
   * @param {string} state
   * @param {string} [reason]
   */
  #say(state, reason = '') {
    // why it has ended is said once, and stays until something else is
    if (state === this.#state && (!reason || reason === this.#reason)) return;
    [this.#state, this.#reason] = [state, reason];
    postMessage({ type: 'state', state, reason });
  }

  /** @param {Uint8Array<ArrayBuffer>} bytes */
  #take(bytes) {
    this.#measurements.bytes += bytes.length;
    // tiles are taken over when they are read: they stay behind the frames that they came behind
    if (!this.#playOut.empty && TILES.includes(bytes[0])) return this.#playOut.push(() => this.#read(bytes), 0, true);
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
      // what was missed comes with the next connection
      return this.#connection.start();
    }
    if (message.kind === 'hello') this.#begin(message);
    else if (message.kind === 'video') this.#video(message);
    else if (message.kind === 'tiles') this.#tiles(message.frame);
    else if (message.kind === 'sound') this.#sound.decode(message);
    else if (message.kind === 'statistics') this.#statistics = message;
    else if (message.kind === 'bye') {
      if (message.cause === 'full') return this.#connection.full();
      if (message.again) return this.#say('ended', message.cause === 'rejected' ? message.reason : '');
      this.#connection.stop();
      this.#say('away', message.reason);
    }
  }

  /** @param {Hello} hello */
  async #begin(hello) {
    if (this.#hidden) this.#connection.send(SOUND_ALONE);
    const before = this.#hello;
    this.#hello = hello;
    if (before?.epoch !== hello.epoch) this.#failures = 0;
    this.#lastPicture = performance.now();
    this.#waits = true;
    [this.#hold, this.#jitter] = [new Hold(), new Jitter()];
    this.#playOut.clear();
    this.#due = Infinity;
    this.#measurements.begin();
    this.#pictures?.close();
    this.#pictures = null;
    this.#drop();
    this.#sound.begin(hello);
    if (!before || JSON.stringify(before.head) !== JSON.stringify(hello.head)) {
      [this.#atlas, this.#told, this.#shown, this.#depthless] = [null, false, null, 0];
      postMessage({ type: 'head', head: hello.head });
    }
    const early = this.#early;
    early.length = 0;
    try {
      const pictures = await Pictures.of(
        hello.codec,
        (decoded) => this.#decoded(decoded),
        (error) => this.#fail(error),
      );
      if (this.#hello !== hello) return pictures.close();
      this.#pictures = pictures;
      this.#connection.well();
      for (const { video, arrived } of early.splice(0)) this.#decode(video, arrived);
    } catch (error) {
      if (!(error instanceof NoDecoder)) throw error;
      this.#connection.stop();
      this.#say('unsupported');
    }
  }

  /**
   * Frames that came while the browser looked for a decoder.
   * @type {{video: Video, arrived: number}[]}
   */
  #early = [];

  /** @param {Video} video */
  #video(video) {
    const arrived = performance.now();
    this.#lastFrame = arrived;
    this.#measurements.arrived(video.time, arrived);
    this.#say('live');
    if (this.#hidden) return;
    const due = this.#jitter.arrived(video.time / 1000, performance.timeOrigin + arrived) - performance.timeOrigin;
    this.#playOut.push(() => this.#play(video, Math.max(arrived, due)), due);
  }

  /**
   * @param {Video} video
   * @param {number} arrived when it came or was due, whichever was later
   */
  #play(video, arrived) {
    this.#hold.arrived(video.frame, arrived);
    if (this.#pictures) this.#decode(video, arrived);
    else this.#early.push({ video, arrived });
  }

  /**
   * @param {Video} video
   * @param {number} arrived
   */
  #decode(video, arrived) {
    if (this.#waits && !video.key) return;
    this.#waits = false;
    this.#pictures?.decode(video, arrived);
  }

  /**
   * A frame gave no picture. The next connection begins with a key frame, but where that does not help either it is over.
   * @param {Error} error
   */
  #fail(error) {
    console.warn(error.message);
    const now = performance.now();
    if (!this.#failures++) this.#failing = now;
    this.#lastPicture = now;
    if (this.#failures < FAILURES || now - this.#failing < FAILING_MS) this.#connection.start();
    else this.#over(error.message);
  }

  /** @param {string} reason why this browser shows nothing */
  #over(reason) {
    this.#connection.stop();
    this.#say('unsupported', reason);
  }

  /** @param {number} frame that came last with its tiles */
  #tiles(frame) {
    this.#hold.tiles(frame, performance.now());
    this.#late = true;
    this.#pump();
  }

  /** @param {Decoded} decoded */
  #decoded(decoded) {
    this.#lastPicture = performance.now();
    this.#measurements.took('video', decoded.ms);
    // one that is held for its tiles has had its time
    if (this.#next && !this.#busy && this.#free && !this.#hidden) {
      this.#due = 0;
      this.#pump();
    }
    this.#drop();
    this.#next = decoded;
    this.#pump();
  }

  /** Whether the page can be sent another picture. */
  get #free() {
    return this.#watched.flat ? this.#underWay.empty : this.#underWay.free(this.#hold.interval);
  }

  /** The newest frame wins. */
  #drop() {
    this.#next?.picture.close();
    this.#next = null;
  }

  /** Shows the next frame once its tiles are there or have had their time, and tiles that came late. */
  async #pump() {
    if (this.#busy || !this.#free || this.#hidden || !this.#hello) return;
    const next = this.#next;
    if (next && this.#watched.flat) return this.#flat(next);
    if (this.#watched.flat || (!next && !(this.#late && this.#shown))) return;
    const now = performance.now();
    if (next) this.#due = Math.min(this.#due, now + this.#hold.left(next, now));
    const wait = next ? this.#due - now : this.#told ? this.#hold.next(now) : 0;
    clearTimeout(this.#timer);
    if (wait > 0) {
      this.#timer = setTimeout(() => this.#pump(), wait);
      return;
    }
    this.#busy = true;
    this.#late = false;
    this.#due = Infinity;
    const { head } = this.#hello;
    let started = performance.now();
    /** @type {VideoFrame | ImageBitmap | null} */
    let plain = null;
    try {
      if (next) {
        this.#next = null;
        plain = await this.#plain(next);
        const pixels = await this.#pixels(next, head);
        if (!pixels || this.#hello.head !== head) return;
        const { format, bytes } = pixels;
        this.#measurements.took('copy', performance.now() - started);
        started = performance.now();
        this.#decoder.frame(format, bytes, next);
        this.#failures = 0;
        this.#shown = next;
      }
      if (this.#compose(head, started)) this.#depthless = 0;
      else if (plain) {
        this.#picture(plain, true);
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
   * The picture of a frame once more, to be shown as it is where there are no layers.
   * @param {Decoded} of
   * @returns {Promise<VideoFrame | ImageBitmap | null>}
   */
  async #plain({ picture }) {
    if (this.#atlas) return null;
    this.#depthless ||= performance.now();
    if (performance.now() - this.#depthless < DEPTH_MS) return null;
    return 'clone' in picture ? picture.clone() : createImageBitmap(picture);
  }

  /**
   * Samples of a frame, or null where they cannot be had in time: the next one is taken in another way then.
   * @param {Decoded} of
   * @param {SceneHead} head
   */
  async #pixels({ picture }, head) {
    const late = new Promise((resume) => setTimeout(() => resume(null), COPY_MS));
    const pixels = await Promise.race([pixelsOf(picture, head, this.#copies), late]).finally(() => picture.close());
    if (!pixels) this.#copies = false;
    return pixels;
  }

  /**
   * Hands on what changed; false where there is nothing to show, as not all tiles came.
   * @param {SceneHead} head
   * @param {number} started
   */
  #compose(head, started) {
    const changed = this.#decoder.layers();
    if (!changed.length && this.#told) {
      // nothing moves: the picture that is shown is this one
      this.#count();
      if (this.#shown) this.#measurements.shown(this.#shown.time);
      return true;
    }
    if (!changed.length && !this.#atlas) return false;
    this.#atlas ??= new TileAtlas(head, this.#watched.side);
    let { numbers, places, reshaped, grown } = this.#atlas.change(changed);
    if (!this.#told) ({ numbers, places } = this.#atlas.all());
    const cells = { places, data: this.#decoder.cells(numbers, this.#spare) };
    this.#spare = undefined;
    const drawn = reshaped || !this.#told ? this.#atlas.drawn() : null;
    const made = performance.now() - started;
    this.#measurements.took('made', made);
    this.#count();
    const whole = drawn !== null && (grown || !this.#told);
    this.#underWay.sent(this.#shown, performance.now(), whole);
    const transfer = [cells.data.buffer, cells.places.buffer];
    if (whole) {
      this.#told = true;
      const atlas = { ...this.#atlas.size, pages: this.#atlas.pages, wide: false, strips: [] };
      self.postMessage({ type: 'scene', scene: { ...head, ...drawn, atlas, decodeMs: made }, cells }, { transfer });
    } else self.postMessage({ type: 'update', instances: drawn?.instances ?? null, cells }, { transfer });
    return true;
  }

  /** @param {Decoded} next */
  #flat(next) {
    this.#failures = 0;
    this.#next = null;
    this.#shown = next;
    this.#picture(next.picture, false);
  }

  /**
   * Has a picture shown as it is.
   * @param {VideoFrame | ImageBitmap} picture
   * @param {boolean} early its tiles are not there yet
   */
  #picture(picture, early) {
    this.#underWay.sent(this.#shown, performance.now(), true);
    this.#count();
    self.postMessage({ type: 'picture', picture, early }, { transfer: [picture] });
  }

  /** A frame counts once, though it is drawn once more for tiles that came late. */
  #count() {
    const frame = this.#shown?.frame ?? -1;
    if (frame !== this.#counted) this.#measurements.frames++;
    this.#counted = frame;
  }

  #tell() {
    const now = performance.now();
    if (this.#state === 'live' && !this.#hidden && now - this.#lastFrame > STALLED_MS) this.#say('stalled');
    if (this.#waits || this.#hidden || this.#state !== 'live') this.#lastPicture = now;
    else if (now - this.#lastPicture > SILENT_MS) this.#over('its decoder gives no picture');
    if (!this.#hidden && !this.#watched.flat && this.#underWay.age(now) > UNSEEN_MS) this.again();
    const { viewers = 0, skipped = 0, geometryMs = 0 } = this.#statistics ?? {};
    const { jitter, delay: buffer } = this.#jitter;
    const frame = this.#shown?.frame ?? -1;
    postMessage({ type: 'statistics', frame, ...this.#measurements.since(TELL_MS), jitter, buffer, viewers, skipped, geometryMs });
  }
}

/** @type {Promise<Room> | null} */
let room = null;

self.onmessage = async ({ data }) => {
  try {
    if (data.watch) room = compiled().then(async (module) => new Room(await RoomDecoder.of(module), data.watch));
    const now = await room;
    if (!now) return;
    if (data.drawn) now.drawn(data.spare);
    if (data.again) now.again();
    if (data.flat) now.flat();
    if ('hidden' in data) now.hidden = data.hidden;
    if ('sound' in data) now.sound = data.sound;
  } catch (error) {
    console.error(error.message);
    postMessage({ type: 'error', message: error.message });
  }
};

// Publishes a camera in a room: frames as fast as the server gives credit for them, the newest first.

import { look, openSocket } from './connection.js';
import { compiled, RoomDecoder } from './decoder.js';
import { codecsFor, encoderOf } from './encoders.js';
import { eachFrame } from './frames.js';
import { eachPacket, SOUND } from './microphone.js';

/** @import { Coded, Encoder } from './encoders.js' */
/** @import { Frame } from './frames.js' */

/** @typedef {'connecting' | 'live' | 'again' | 'paused' | 'ended'} State `again`: the connection broke and is tried again; `paused`: the camera gives no frames, as in a hidden tab, and it goes on with the next one; `ended` with a reason, or without one where it was stopped */

/** A key frame comes at least so often, frames: who joins gets all since the last one. */
const GROUP = 60;
/** Pauses before it is tried again, ms. */
const PAUSES_MS = [300, 700, 1500, 3000];
/** Bytes that may wait in the socket: beyond, the network is the bottleneck and frames are left out. */
const MOST_WAITING = 256 << 10;
/** Silence after which a connection is taken for dead: the server says something each second, ms. */
const SILENCE_MS = 4000;
/** Time without a frame or sound after which the room is left until the next frame comes, ms: sooner than the server sends who says nothing away. */
const QUIET_MS = 7000;
/** Time that a microphone has to begin, ms. */
const MICROPHONE_MS = 3000;
/** Frames in a row that may fail before it ends. */
const FAILURES = 5;

/** Now in µs, by a clock that others on the machine have, too. */
const clock = () => Math.round((performance.timeOrigin + performance.now()) * 1000);

export class Publisher {
  #room;
  #stream;
  #preview;
  #tell;
  /** @type {RoomDecoder | null} */
  #wire = null;
  /** @type {WebSocket | null} */
  #socket = null;
  /** @type {Encoder | null} */
  #encoder = null;
  /** @type {(() => void)[]} */
  #stops = [];
  #size = { width: 0, height: 0 };
  /** Counts connections, also those that are given up while they wait for something. */
  #run = 0;
  #codec = 0;
  #credit = 0;
  #number = 0;
  #sinceKey = 0;
  #wantsKey = true;
  #tries = 0;
  #failures = 0;
  #stopped = false;
  #paused = false;
  #wasLive = false;
  /** Stops the sound; null: there is none. @type {(() => void) | null} */
  #stopSound = null;
  /** When something was there to be sent last, ms. */
  #last = 0;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #timer;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #silence;
  /** Frames and bytes sent, and frames left out, since the start. */
  counts = { frames: 0, bytes: 0, leftOut: 0, sound: 0 };

  /**
   * @param {{address: string, token: string}} room
   * @param {MediaStream} stream
   * @param {HTMLVideoElement} preview that shows it
   * @param {(state: State, reason: string) => void} tell
   */
  constructor(room, stream, preview, tell) {
    this.#room = room;
    this.#stream = stream;
    this.#preview = preview;
    this.#tell = tell;
  }

  /** What the frames are coded by. */
  get codec() {
    return this.#encoder?.codec ?? '';
  }

  /** Whether sound is sent. */
  get hasSound() {
    return this.#stopSound !== null;
  }

  async start() {
    this.#tell('connecting', '');
    this.#wire = await RoomDecoder.of(await compiled());
    // what is said of sound is said first, so it has to be known
    await this.#startSound();
    if (this.#stopped) return this.#release();
    const [video] = this.#stream.getVideoTracks();
    video.addEventListener('ended', () => this.#end('the camera was taken away'));
    const failed = (/** @type {Error} */ error) => this.#fail(error);
    this.#stops.push(eachFrame(video, this.#preview, (frame) => this.#take(frame), failed));
    const watch = setInterval(() => this.#rest(), 1000);
    this.#stops.push(() => clearInterval(watch));
  }

  /** Without sound there is still a picture. */
  async #startSound() {
    const [sound] = this.#stream.getAudioTracks();
    if (!sound) return;
    const begun = eachPacket(
      sound,
      clock,
      (packet) => this.#sound(packet),
      (error) => this.#mute(error.message),
    );
    const late = new Promise((_, refuse) => setTimeout(() => refuse(new Error('the microphone does not begin')), MICROPHONE_MS));
    try {
      this.#stopSound = await Promise.race([begun, late]);
      sound.addEventListener('ended', () => this.#mute('the microphone was taken away'));
    } catch (error) {
      console.warn(error.message);
      // one that begins after all is not announced
      begun.then((stop) => stop()).catch(() => {});
    }
  }

  /**
   * The sound has failed: those who watch are told that there is none.
   * @param {string} reason
   */
  #mute(reason) {
    console.warn(reason);
    if (!this.#stopSound) return;
    this.#stopSound();
    this.#stopSound = null;
    if (this.#socket) this.#connect();
  }

  /**
   * A frame could not be sent.
   * @param {Error} error
   */
  #fail(error) {
    console.warn(error.message);
    if (++this.#failures > FAILURES) this.#end(error.message);
    else this.#again();
  }

  /** Leaves the room where nothing comes of the camera: the server would send away who says nothing. */
  #rest() {
    if (!this.#socket || this.#paused || performance.now() - this.#last < QUIET_MS) return;
    this.#pause();
  }

  #pause() {
    if (this.#socket?.readyState === WebSocket.OPEN && this.#wire) this.#socket.send(this.#wire.writeBye('paused'));
    clearTimeout(this.#timer);
    this.#disconnect();
    this.#paused = true;
    this.#tell('paused', '');
  }

  stop() {
    const { readyState, OPEN } = this.#socket ?? { readyState: 0, OPEN: 1 };
    if (readyState === OPEN && this.#wire) this.#socket?.send(this.#wire.writeBye('stopped'));
    this.#end('');
  }

  /** @param {string} reason */
  #end(reason) {
    if (this.#stopped) return;
    this.#stopped = true;
    this.#release();
    this.#tell('ended', reason);
  }

  #release() {
    clearTimeout(this.#timer);
    for (const stop of this.#stops.splice(0)) stop();
    this.#stopSound?.();
    this.#stopSound = null;
    this.#disconnect();
  }

  #disconnect() {
    this.#run++;
    clearTimeout(this.#silence);
    this.#encoder?.close();
    this.#encoder = null;
    if (!this.#socket) return;
    this.#socket.onclose = this.#socket.onmessage = this.#socket.onopen = null;
    this.#socket.close();
    this.#socket = null;
  }

  /** @param {Frame} frame */
  #take(frame) {
    const { displayWidth: width, displayHeight: height } = frame;
    this.#last = performance.now();
    if (this.#paused || width !== this.#size.width || height !== this.#size.height) {
      // the first one, or one after a pause, or the device was turned: the room begins anew
      this.#paused = false;
      this.#size = { width, height };
      this.#connect();
    }
    const waiting = this.#socket?.bufferedAmount ?? 0;
    if (!this.#encoder || this.#credit <= this.#encoder.busy || waiting > MOST_WAITING) {
      if (this.#encoder) this.counts.leftOut++;
      return frame.close();
    }
    const key = this.#wantsKey || this.#sinceKey >= GROUP;
    this.#wantsKey = false;
    this.#sinceKey = key ? 1 : this.#sinceKey + 1;
    this.#encoder.encode(frame, clock(), key);
  }

  async #connect() {
    this.#disconnect();
    clearTimeout(this.#timer);
    const size = this.#size;
    const run = this.#run;
    const [codecs, refused] = await Promise.all([codecsFor(size), this.#refusal()]);
    if (this.#stopped || this.#paused || run !== this.#run) return;
    if (refused) return this.#end(refused);
    const config = codecs[Math.min(this.#codec, codecs.length - 1)];
    const socket = openSocket(this.#room.address, 'publish', this.#room.token);
    this.#socket = socket;
    [this.#credit, this.#number, this.#wantsKey] = [0, 0, true];
    socket.onopen = () => {
      const sound = this.#stopSound ? SOUND : null;
      const named = sound ? { sound: sound.codec, rate: sound.rate, channels: sound.channels } : {};
      const hello = this.#wire?.writeHello({ ...size, codec: config.codec.replace('avc1.42E01F', 'avc1.42e01f'), ...named });
      if (hello) socket.send(hello);
      this.#encoder = encoderOf(
        config,
        (coded) => this.#send(coded),
        () => {
          // it cannot after all
          this.#codec++;
          this.#connect();
        },
      );
    };
    this.#listen();
    socket.onmessage = ({ data }) => {
      this.#listen();
      this.#hear(new Uint8Array(data));
    };
    socket.onclose = () => this.#again();
  }

  /** Why it is of no use to try again, empty where it may be: a socket that is refused does not say why. */
  async #refusal() {
    if (!this.#tries) return '';
    const { state, mayPublish } = await look(this.#room.address, this.#room.token);
    if (state === 'none') return 'There is no such room on this server.';
    return state === 'refused' || (state !== 'away' && !mayPublish) ? 'the link is no longer valid' : '';
  }

  /** A link that is dead says nothing of it. */
  #listen() {
    clearTimeout(this.#silence);
    this.#silence = setTimeout(() => this.#again(), SILENCE_MS);
  }

  /** @param {Uint8Array} bytes */
  #hear(bytes) {
    const message = this.#wire?.read(bytes);
    if (message?.kind === 'credit') {
      this.#credit += message.frames;
      this.#wantsKey ||= message.key;
      if (message.frames) {
        this.#tries = 0;
        this.#wasLive = true;
        this.#tell('live', '');
      }
    } else if (message?.kind === 'bye') {
      if (message.cause === 'codec') {
        this.#codec++;
        this.#connect();
      } else if (message.again || (message.cause === 'taken' && this.#wasLive)) this.#again();
      else this.#end(message.reason);
    }
  }

  #again() {
    this.#disconnect();
    if (this.#stopped || this.#paused) return;
    // it would be sent away again
    if (this.#wasLive && performance.now() - this.#last > QUIET_MS) return this.#pause();
    this.#tell('again', '');
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#connect(), PAUSES_MS[Math.min(this.#tries++, PAUSES_MS.length - 1)]);
  }

  /** @param {Coded} coded */
  #send({ time, key, layer, data }) {
    const { OPEN } = WebSocket;
    if (this.#socket?.readyState !== OPEN || !this.#wire) return;
    this.#credit--;
    this.#socket.send(this.#wire.writeVideo({ frame: this.#number++, time, key, layer, data }));
    this.#failures = 0;
    this.counts.frames++;
    this.counts.bytes += data.length;
  }

  /** @param {{time: number, data: Uint8Array}} packet */
  #sound(packet) {
    if (this.#socket?.readyState !== WebSocket.OPEN || !this.#wire || !this.#number) return;
    this.#socket.send(this.#wire.writeSound(packet));
    this.#last = performance.now();
    this.counts.sound++;
  }
}

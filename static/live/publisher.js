// Publishes a camera in a room: frames as fast as the server gives credit for them, the newest first.

import { openSocket } from './connection.js';
import { compiled, RoomDecoder } from './decoder.js';
import { codecsFor, encoderOf } from './encoders.js';
import { eachFrame } from './frames.js';
import { eachPacket, SOUND } from './microphone.js';

/** @import { Coded, Encoder } from './encoders.js' */
/** @import { Frame } from './frames.js' */

/** @typedef {'connecting' | 'live' | 'again' | 'ended'} State `again`: the connection broke and is tried again; `ended` with a reason, or without one where it was stopped */

/** A key frame comes at least so often, frames: who joins gets all since the last one. */
const GROUP = 60;
/** Pauses before it is tried again, ms. */
const PAUSES_MS = [300, 700, 1500, 3000];
/** Bytes that may wait in the socket: beyond, the network is the bottleneck and frames are left out. */
const MOST_WAITING = 256 << 10;
/** Silence after which a connection is taken for dead: the server says something each second, ms. */
const SILENCE_MS = 4000;
/** What the server says to a codec that it has no decoder for, and where the room is taken. */
const NO_DECODER = /no decoder for the codec/;
const TAKEN = /someone publishes in this room/;

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
  #codec = 0;
  #credit = 0;
  #number = 0;
  #sinceKey = 0;
  #wantsKey = true;
  #tries = 0;
  #stopped = false;
  #wasLive = false;
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

  async start() {
    this.#tell('connecting', '');
    this.#wire = await RoomDecoder.of(await compiled());
    const [video] = this.#stream.getVideoTracks();
    video.addEventListener('ended', () => this.#end('the camera was taken away'));
    this.#stops.push(eachFrame(video, this.#preview, (frame) => this.#take(frame)));
    const [sound] = this.#stream.getAudioTracks();
    if (sound) this.#stops.push(await eachPacket(sound, clock, (packet) => this.#sound(packet)));
    // stopped while it began
    if (this.#stopped) this.#release();
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
    this.#disconnect();
  }

  #disconnect() {
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
    if (width !== this.#size.width || height !== this.#size.height) {
      // the first one, or the device was turned: the room begins anew
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
    const size = this.#size;
    const codecs = await codecsFor(size);
    if (this.#stopped || size !== this.#size) return;
    const config = codecs[Math.min(this.#codec, codecs.length - 1)];
    const socket = openSocket(this.#room.address, 'publish', this.#room.token);
    this.#socket = socket;
    [this.#credit, this.#number, this.#wantsKey] = [0, 0, true];
    socket.onopen = () => {
      const sound = this.#stream.getAudioTracks().length ? SOUND : null;
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
      if (NO_DECODER.test(message.reason)) {
        this.#codec++;
        this.#connect();
      } else if (message.again || (TAKEN.test(message.reason) && this.#wasLive)) this.#again();
      else this.#end(message.reason);
    }
  }

  #again() {
    this.#disconnect();
    if (this.#stopped) return;
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
    this.counts.frames++;
    this.counts.bytes += data.length;
  }

  /** @param {{time: number, data: Uint8Array}} packet */
  #sound(packet) {
    if (this.#socket?.readyState !== WebSocket.OPEN || !this.#wire || !this.#number) return;
    this.#socket.send(this.#wire.writeSound(packet));
    this.counts.sound++;
  }
}

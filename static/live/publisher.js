// Publishes a camera to a room, as fast as the server grants credit; if frames must be dropped, the newest is kept.

import { eachFrame } from './camera-frames.js';
import { fetchStatus, openSocket } from './connection.js';
import { compiled, RoomDecoder } from './decoder.js';
import { codecsFor, encoderOf } from './encoders.js';
import { eachPacket, SOUND } from './microphone.js';

/** @import { Coded, Encoder } from './encoders.js' */
/** @import { Frame } from './camera-frames.js' */

/**
 * `again`: the connection broke and is being reopened; `paused`: the camera delivers no frames, as in a hidden tab, and the next frame
 * resumes; `ended`: with a reason, or without one after `stop`.
 * @typedef {'connecting' | 'live' | 'again' | 'paused' | 'ended'} State
 */

/** Longest key frame interval, frames: a viewer who joins gets all frames since the last key frame. */
const KEY_INTERVAL = 60;
/** Pauses before successive reconnects, ms. */
const PAUSES_MS = [300, 700, 1500, 3000];
/** Most bytes queued in the socket; beyond that the network is the bottleneck, and frames are dropped. */
const MAX_BUFFERED = 256 << 10;
/** Silence after which a connection counts as lost, ms: the server sends something every second. */
const SILENCE_MS = 4000;
/** Time without frames or sound after which publishing pauses, ms: shorter than the time after which the server disconnects a publisher. */
const IDLE_MS = 7000;
/** Time limit for the microphone to start, ms. */
const MICROPHONE_MS = 3000;
/** Most consecutive frames that may fail before publishing ends. */
const MAX_FAILURES = 5;

/** Current time in µs since 1970, comparable with other programs on the machine. */
const clock = () => Math.round((performance.timeOrigin + performance.now()) * 1000);

export class Publisher {
  #room;
  #stream;
  #preview;
  #onState;
  /** @type {RoomDecoder | null} */
  #messages = null;
  /** @type {WebSocket | null} */
  #socket = null;
  /** @type {Encoder | null} */
  #encoder = null;
  /** @type {(() => void)[]} */
  #stops = [];
  #size = { width: 0, height: 0 };
  /** Counts connections, so that an abandoned one notices it after an await. */
  #attempt = 0;
  #codecIndex = 0;
  #credit = 0;
  #frameNumber = 0;
  #sinceKey = 0;
  #wantsKey = true;
  #tries = 0;
  #failures = 0;
  #stopped = false;
  #paused = false;
  #wasLive = false;
  /** Stops the sound; null without sound. @type {(() => void) | null} */
  #stopSound = null;
  /** Time of the last frame or sound packet, ms. */
  #lastInput = 0;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #timer;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #silence;
  /** Totals since the start: frames and bytes sent, frames dropped, sound packets sent. */
  counts = { frames: 0, bytes: 0, leftOut: 0, sound: 0 };

  /**
   * @param {{address: string, token: string}} room
   * @param {MediaStream} stream
   * @param {HTMLVideoElement} preview that shows it
   * @param {(state: State, reason: string) => void} onState
   */
  constructor(room, stream, preview, onState) {
    this.#room = room;
    this.#stream = stream;
    this.#preview = preview;
    this.#onState = onState;
  }

  /** Codec string of the current encoder. */
  get codec() {
    return this.#encoder?.codec ?? '';
  }

  /** Whether sound is sent. */
  get hasSound() {
    return this.#stopSound !== null;
  }

  async start() {
    this.#onState('connecting', '');
    this.#messages = await RoomDecoder.of(await compiled());
    // HELLO announces the sound, so the microphone starts before the connection
    await this.#startSound();
    if (this.#stopped) return this.#release();
    const [video] = this.#stream.getVideoTracks();
    video.addEventListener('ended', () => this.#end('the camera was taken away'));
    const failed = (/** @type {Error} */ error) => this.#fail(error);
    this.#stops.push(eachFrame(video, this.#preview, (frame) => this.#take(frame), failed));
    const watch = setInterval(() => this.#pauseIfIdle(), 1000);
    this.#stops.push(() => clearInterval(watch));
  }

  /** Starts the sound; a failure leaves a room without sound. */
  async #startSound() {
    const [sound] = this.#stream.getAudioTracks();
    if (!sound) return;
    const begun = eachPacket(
      sound,
      clock,
      (packet) => this.#sendSound(packet),
      (error) => this.#mute(error.message),
    );
    const late = new Promise((_, refuse) => setTimeout(() => refuse(new Error('the microphone did not start')), MICROPHONE_MS));
    try {
      this.#stopSound = await Promise.race([begun, late]);
      sound.addEventListener('ended', () => this.#mute('the microphone was taken away'));
    } catch (error) {
      console.warn(error.message);
      // HELLO has not announced it, so stop it if it starts later
      begun.then((stop) => stop()).catch(() => {});
    }
  }

  /**
   * Stops the failed sound and reconnects, so that HELLO tells viewers that there is none.
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
   * Handles a frame that could not be sent.
   * @param {Error} error
   */
  #fail(error) {
    console.warn(error.message);
    if (++this.#failures > MAX_FAILURES) this.#end(error.message);
    else this.#reconnect();
  }

  /** Pauses if the camera delivers nothing: the server would disconnect a silent publisher. */
  #pauseIfIdle() {
    if (!this.#socket || this.#paused || performance.now() - this.#lastInput < IDLE_MS) return;
    this.#pause();
  }

  #pause() {
    if (this.#socket?.readyState === WebSocket.OPEN && this.#messages) this.#socket.send(this.#messages.writeBye('paused'));
    clearTimeout(this.#timer);
    this.#disconnect();
    this.#paused = true;
    this.#onState('paused', '');
  }

  stop() {
    const { readyState, OPEN } = this.#socket ?? { readyState: 0, OPEN: 1 };
    if (readyState === OPEN && this.#messages) this.#socket?.send(this.#messages.writeBye('stopped'));
    this.#end('');
  }

  /** @param {string} reason */
  #end(reason) {
    if (this.#stopped) return;
    this.#stopped = true;
    this.#release();
    this.#onState('ended', reason);
  }

  #release() {
    clearTimeout(this.#timer);
    for (const stop of this.#stops.splice(0)) stop();
    this.#stopSound?.();
    this.#stopSound = null;
    this.#disconnect();
  }

  #disconnect() {
    this.#attempt++;
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
    this.#lastInput = performance.now();
    if (this.#paused || width !== this.#size.width || height !== this.#size.height) {
      // the first frame, the first one after a pause, or the device was rotated: a new HELLO is due
      this.#paused = false;
      this.#size = { width, height };
      this.#connect();
    }
    const waiting = this.#socket?.bufferedAmount ?? 0;
    if (!this.#encoder || this.#credit <= this.#encoder.busy || waiting > MAX_BUFFERED) {
      if (this.#encoder) this.counts.leftOut++;
      return frame.close();
    }
    const key = this.#wantsKey || this.#sinceKey >= KEY_INTERVAL;
    this.#wantsKey = false;
    this.#sinceKey = key ? 1 : this.#sinceKey + 1;
    this.#encoder.encode(frame, clock(), key);
  }

  async #connect() {
    this.#disconnect();
    clearTimeout(this.#timer);
    const size = this.#size;
    const attempt = this.#attempt;
    const [codecs, refused] = await Promise.all([codecsFor(size), this.#refusedReason()]);
    if (this.#stopped || this.#paused || attempt !== this.#attempt) return;
    if (refused) return this.#end(refused);
    const config = codecs[Math.min(this.#codecIndex, codecs.length - 1)];
    const socket = openSocket(this.#room.address, 'publish', this.#room.token);
    this.#socket = socket;
    [this.#credit, this.#frameNumber, this.#wantsKey] = [0, 0, true];
    socket.onopen = () => {
      const sound = this.#stopSound ? SOUND : null;
      const named = sound ? { sound: sound.codec, rate: sound.rate, channels: sound.channels } : {};
      const hello = this.#messages?.writeHello({ ...size, codec: config.codec.replace('avc1.42E01F', 'avc1.42e01f'), ...named });
      if (hello) socket.send(hello);
      this.#encoder = encoderOf(
        config,
        (coded) => this.#send(coded),
        () => {
          // the encoder failed although the browser claims support
          this.#codecIndex++;
          this.#connect();
        },
      );
    };
    this.#watchSilence();
    socket.onmessage = ({ data }) => {
      this.#watchSilence();
      this.#onMessage(new Uint8Array(data));
    };
    socket.onclose = () => this.#reconnect();
  }

  /** Why reconnecting is pointless, or empty: a rejected WebSocket reports no reason. */
  async #refusedReason() {
    if (!this.#tries) return '';
    const { state, mayPublish } = await fetchStatus(this.#room.address, this.#room.token);
    if (state === 'none') return 'There is no such room on this server.';
    return state === 'refused' || (state !== 'away' && !mayPublish) ? 'the link is no longer valid' : '';
  }

  /** Restarts the silence timer: a dead connection raises no event. */
  #watchSilence() {
    clearTimeout(this.#silence);
    this.#silence = setTimeout(() => this.#reconnect(), SILENCE_MS);
  }

  /** @param {Uint8Array} bytes */
  #onMessage(bytes) {
    const message = this.#messages?.read(bytes);
    if (message?.kind === 'credit') {
      this.#credit += message.frames;
      this.#wantsKey ||= message.key;
      if (message.frames) {
        this.#tries = 0;
        this.#wasLive = true;
        this.#onState('live', '');
      }
    } else if (message?.kind === 'bye') {
      if (message.cause === 'codec') {
        this.#codecIndex++;
        this.#connect();
      } else if (message.again || (message.cause === 'taken' && this.#wasLive)) this.#reconnect();
      else this.#end(message.reason);
    }
  }

  #reconnect() {
    this.#disconnect();
    if (this.#stopped || this.#paused) return;
    // the server would disconnect it again
    if (this.#wasLive && performance.now() - this.#lastInput > IDLE_MS) return this.#pause();
    this.#onState('again', '');
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.#connect(), PAUSES_MS[Math.min(this.#tries++, PAUSES_MS.length - 1)]);
  }

  /** @param {Coded} coded */
  #send({ time, key, layer, data }) {
    const { OPEN } = WebSocket;
    if (this.#socket?.readyState !== OPEN || !this.#messages) return;
    this.#credit--;
    this.#socket.send(this.#messages.writeVideo({ frame: this.#frameNumber++, time, key, layer, data }));
    this.#failures = 0;
    this.counts.frames++;
    this.counts.bytes += data.length;
  }

  /** @param {{time: number, data: Uint8Array}} packet */
  #sendSound(packet) {
    if (this.#socket?.readyState !== WebSocket.OPEN || !this.#messages || !this.#frameNumber) return;
    this.#socket.send(this.#messages.writeSound(packet));
    this.#lastInput = performance.now();
    this.counts.sound++;
  }
}

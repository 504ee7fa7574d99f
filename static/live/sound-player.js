// Plays the sound of a room in sync with its picture.

/** Smallest amount of sound buffered ahead, s: it hides packets that are late by less. */
const MIN_AHEAD_S = 0.06;
/** Drift beyond which the sound is resynchronised, s. */
const MAX_DRIFT_S = 0.12;

export class SoundPlayer {
  /** @type {AudioContext | null} */
  #context = null;
  /** Offset from a packet's time to the context's, s. */
  #offset = 0;
  #synced = false;
  /** Delay from capture to display of the picture, s; 0 if unknown. */
  late = 0;
  /** Seconds of sound played. */
  played = 0;
  /** Peak of the last packet. */
  level = 0;

  /** Call it from a user gesture. */
  async start() {
    this.#context ??= new AudioContext({ latencyHint: 'interactive' });
    await this.#context.resume();
    this.#synced = false;
  }

  async stop() {
    await this.#context?.suspend();
  }

  /** Closes the audio context; the player cannot be started again. */
  async close() {
    const context = this.#context;
    this.#context = null;
    await context?.close();
  }

  /**
   * @param {{time: number, rate: number, planes: Float32Array<ArrayBuffer>[]}} packet `time` in µs by the publisher's clock
   */
  play({ time, rate, planes }) {
    const context = this.#context;
    if (context?.state !== 'running' || !planes[0]?.length) return;
    const taken = time / 1e6;
    const clock = (performance.timeOrigin + performance.now()) / 1e3;
    // in sync with the picture, but not before the packet is there
    const wanted = context.currentTime + Math.max(MIN_AHEAD_S, Math.min(1, this.late - (clock - taken)));
    if (!this.#synced || Math.abs(taken + this.#offset - wanted) > MAX_DRIFT_S) {
      this.#offset = wanted - taken;
      this.#synced = true;
    }
    const buffer = context.createBuffer(planes.length, planes[0].length, rate);
    planes.forEach((samples, i) => {
      buffer.copyToChannel(samples, i);
    });
    const source = context.createBufferSource();
    source.buffer = buffer;
    source.connect(context.destination);
    source.start(Math.max(context.currentTime, taken + this.#offset));
    this.played += buffer.duration;
    this.level = planes[0].reduce((most, v) => Math.max(most, Math.abs(v)), 0);
  }
}

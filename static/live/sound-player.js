// Plays the sound of a room in step with its pictures.

/** Sound is kept this far ahead at least, s: what comes late by less is not heard. */
const AHEAD_S = 0.06;
/** Out of step by more than this, s, it is put in step again. */
const OFF_S = 0.12;

export class SoundPlayer {
  /** @type {AudioContext | null} */
  #context = null;
  /** What is to be added to a packet's time for the context's, s. */
  #offset = 0;
  #set = false;
  /** How late pictures are shown after they were taken, s; none is known: 0. */
  late = 0;
  /** Seconds of sound that were played. */
  played = 0;
  /** The loudest sample of the last packet. */
  level = 0;

  /** To be called from a tap. */
  async start() {
    this.#context ??= new AudioContext({ latencyHint: 'interactive' });
    await this.#context.resume();
    this.#set = false;
  }

  async stop() {
    await this.#context?.suspend();
  }

  /** For good. */
  async close() {
    const context = this.#context;
    this.#context = null;
    await context?.close();
  }

  /**
   * @param {{time: number, rate: number, planes: Float32Array<ArrayBuffer>[]}} packet time in µs by the publisher's clock
   */
  play({ time, rate, planes }) {
    const context = this.#context;
    if (context?.state !== 'running' || !planes[0]?.length) return;
    const taken = time / 1e6;
    const clock = (performance.timeOrigin + performance.now()) / 1e3;
    // with the picture of the same moment, but not before it is here
    const wanted = context.currentTime + Math.max(AHEAD_S, Math.min(1, this.late - (clock - taken)));
    if (!this.#set || Math.abs(taken + this.#offset - wanted) > OFF_S) {
      this.#offset = wanted - taken;
      this.#set = true;
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

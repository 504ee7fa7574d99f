// Decodes the sound of a room; the page plays the samples.

/** @import { Hello, Sound } from './decoder.js' */

export class SoundDecoder {
  /** @type {AudioDecoder | null} */
  #decoder = null;
  /** @type {Hello | null} */
  #hello = null;
  /** Whether the sound is on. */
  wanted = false;

  /** @param {Hello} hello */
  begin(hello) {
    this.#close();
    this.#hello = hello.sound ? hello : null;
    postMessage({ type: 'has-sound', on: Boolean(hello.sound && globalThis.AudioDecoder) });
  }

  /** @param {Sound} sound */
  decode({ time, data }) {
    if (!this.wanted || !this.#hello || !globalThis.AudioDecoder) return;
    try {
      this.#decoder ??= this.#open(this.#hello);
      this.#decoder.decode(new EncodedAudioChunk({ type: 'key', timestamp: time, data }));
    } catch (error) {
      console.warn(error.message);
      this.#close();
    }
  }

  /** @param {Hello} hello */
  #open({ sound, rate, channels }) {
    const decoder = new AudioDecoder({
      output: (data) => {
        const planes = Array.from({ length: data.numberOfChannels }, (_, i) => {
          const samples = new Float32Array(data.numberOfFrames);
          data.copyTo(samples, { planeIndex: i, format: 'f32-planar' });
          return samples;
        });
        const transfer = planes.map(({ buffer }) => buffer);
        self.postMessage({ type: 'sound', time: data.timestamp, rate: data.sampleRate, planes }, { transfer });
        data.close();
      },
      error: (error) => {
        console.warn(error.message);
        this.#decoder = null;
      },
    });
    decoder.configure({ codec: sound, sampleRate: rate, numberOfChannels: channels });
    return decoder;
  }

  #close() {
    if (this.#decoder && this.#decoder.state !== 'closed') this.#decoder.close();
    this.#decoder = null;
  }
}

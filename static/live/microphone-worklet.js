// Runs beside the page: hands on what the microphone hears.

// names of its own world
const { AudioWorkletProcessor, registerProcessor } = /** @type {any} */ (globalThis);

class Microphone extends AudioWorkletProcessor {
  /** @param {Float32Array[][]} inputs */
  process([[samples]]) {
    // the buffer is used again
    if (samples) this.port.postMessage(samples.slice());
    return true;
  }
}

registerProcessor('tmpi-microphone', Microphone);

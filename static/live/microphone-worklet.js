// Audio worklet: forwards the samples of the microphone.

// globals of AudioWorkletGlobalScope
const { AudioWorkletProcessor, registerProcessor } = /** @type {any} */ (globalThis);

class Microphone extends AudioWorkletProcessor {
  /** @param {Float32Array[][]} inputs */
  process([[samples]]) {
    // the browser reuses the buffer
    if (samples) this.port.postMessage(samples.slice());
    return true;
  }
}

registerProcessor('tmpi-microphone', Microphone);

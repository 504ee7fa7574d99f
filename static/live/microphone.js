// Encodes the sound of a microphone as Opus packets.

export const SOUND = Object.freeze({ codec: 'opus', rate: 48_000, channels: 1 });
const BITRATE = 32_000;
/** Samples per packet: 20 ms. */
const PACKET_SAMPLES = 960;
/** Drift beyond which timestamps are resynchronised, µs: the microphone has its own clock. */
const MAX_DRIFT_US = 60_000;

/** Whether this browser can encode Opus. */
export async function hasOpus() {
  if (!globalThis.AudioEncoder || !globalThis.AudioWorkletNode) return false;
  const config = { codec: SOUND.codec, sampleRate: SOUND.rate, numberOfChannels: SOUND.channels, bitrate: BITRATE };
  return (await AudioEncoder.isConfigSupported(config).catch(() => ({ supported: false }))).supported ?? false;
}

/**
 * Calls `take` with every packet and its time by `clock`, until stopped.
 * @param {MediaStreamTrack} track
 * @param {() => number} clock µs
 * @param {(packet: {time: number, data: Uint8Array<ArrayBuffer>}) => void} take
 * @param {(error: Error) => void} failed called on an error; no packet follows
 * @returns {Promise<() => void>} stops recording
 */
export async function eachPacket(track, clock, take, failed) {
  const context = new AudioContext({ sampleRate: SOUND.rate });
  await context.audioWorklet.addModule(new URL('./microphone-worklet.js', import.meta.url));
  const encoder = new AudioEncoder({
    output: (chunk) => {
      const data = new Uint8Array(chunk.byteLength);
      chunk.copyTo(data);
      take({ time: chunk.timestamp, data });
    },
    error: failed,
  });
  encoder.configure({ codec: SOUND.codec, sampleRate: SOUND.rate, numberOfChannels: SOUND.channels, bitrate: BITRATE });
  const node = new AudioWorkletNode(context, 'tmpi-microphone', { numberOfOutputs: 0 });
  const packet = new Float32Array(PACKET_SAMPLES);
  let filled = 0;
  let time = 0;
  node.port.onmessage = ({ data }) => {
    for (let at = 0; at < data.length; ) {
      const part = data.subarray(at, at + PACKET_SAMPLES - filled);
      packet.set(part, filled);
      filled += part.length;
      at += part.length;
      if (filled < PACKET_SAMPLES) continue;
      filled = 0;
      const length = (PACKET_SAMPLES / SOUND.rate) * 1e6;
      const now = clock() - length;
      time = Math.abs(now - time - length) > MAX_DRIFT_US ? now : time + length;
      if (encoder.state !== 'configured') return;
      const samples = { format: /** @type {const} */ ('f32-planar'), sampleRate: SOUND.rate, numberOfFrames: PACKET_SAMPLES };
      const sound = new AudioData({ ...samples, numberOfChannels: 1, timestamp: Math.round(time), data: packet });
      encoder.encode(sound);
      sound.close();
    }
  };
  context.createMediaStreamSource(new MediaStream([track])).connect(node);
  await context.resume();
  return () => {
    node.port.onmessage = null;
    if (encoder.state !== 'closed') encoder.close();
    context.close();
  };
}

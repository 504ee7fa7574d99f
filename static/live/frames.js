// Frames of a camera as they come: by a track processor where the browser has one, else from the preview.

/** @typedef {{preview: HTMLVideoElement, displayWidth: number, displayHeight: number, close: () => void}} Shown what the preview shows now, where the browser knows no `VideoFrame` */
/** @typedef {VideoFrame | Shown} Frame */

/**
 * Hands every frame to `take`, which closes it, until stopped.
 * @param {MediaStreamTrack} track
 * @param {HTMLVideoElement} preview that shows the track
 * @param {(frame: Frame) => void} take
 * @returns {() => void} stops
 */
export function eachFrame(track, preview, take) {
  const Processor = /** @type {any} */ (globalThis).MediaStreamTrackProcessor;
  return Processor ? processed(new Processor({ track, maxBufferSize: 1 }), take) : previewed(preview, take);
}

/**
 * What is drawn of a frame.
 * @param {Frame} frame
 * @returns {CanvasImageSource}
 */
export function pictureOf(frame) {
  return 'preview' in frame ? frame.preview : frame;
}

/**
 * @param {{readable: ReadableStream<VideoFrame>}} processor
 * @param {(frame: Frame) => void} take
 */
function processed({ readable }, take) {
  const reader = readable.getReader();
  let stopped = false;
  const read = async () => {
    while (!stopped) {
      const { done, value } = await reader.read();
      if (done) return;
      if (stopped) value.close();
      else take(value);
    }
  };
  // the track has ended
  read().catch(() => {});
  return () => {
    stopped = true;
    reader.cancel().catch(() => {});
  };
}

/**
 * @param {HTMLVideoElement} preview
 * @returns {Frame}
 */
function shown(preview) {
  if (globalThis.VideoFrame) return new VideoFrame(preview, { timestamp: Math.round(performance.now() * 1000) });
  return { preview, displayWidth: preview.videoWidth, displayHeight: preview.videoHeight, close: () => {} };
}

/**
 * @param {HTMLVideoElement} preview
 * @param {(frame: Frame) => void} take
 */
function previewed(preview, take) {
  let stopped = false;
  const next = () => {
    if (stopped) return;
    if (preview.videoWidth) take(shown(preview));
    preview.requestVideoFrameCallback(next);
  };
  preview.requestVideoFrameCallback(next);
  return () => {
    stopped = true;
  };
}

// Frames of a camera as they come: by a track processor where the browser has one, else from the preview.

/** @typedef {{preview: HTMLVideoElement, displayWidth: number, displayHeight: number, close: () => void}} Shown what the preview shows now, where the browser knows no `VideoFrame` */
/** @typedef {VideoFrame | Shown} Frame */

/**
 * Hands every frame to `take`, which closes it, until stopped.
 * @param {MediaStreamTrack} track
 * @param {HTMLVideoElement} preview that shows the track
 * @param {(frame: Frame) => void} take
 * @param {(error: Error) => void} failed told where `take` throws or the camera cannot be read; frames go on coming in the first case
 * @returns {() => void} stops
 */
export function eachFrame(track, preview, take, failed) {
  const Processor = /** @type {any} */ (globalThis).MediaStreamTrackProcessor;
  /** @param {Frame} frame */
  const taken = (frame) => {
    try {
      take(frame);
    } catch (error) {
      // an open frame would hold the camera up
      frame.close();
      failed(error);
    }
  };
  return Processor ? processed(new Processor({ track, maxBufferSize: 1 }), taken, failed) : previewed(preview, taken, failed);
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
 * @param {(error: Error) => void} failed
 */
function processed({ readable }, take, failed) {
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
  // a track that has ended is done, and no error
  read().catch((error) => {
    if (!stopped) failed(error);
  });
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
 * @param {(error: Error) => void} failed
 */
function previewed(preview, take, failed) {
  let stopped = false;
  const next = () => {
    if (stopped) return;
    try {
      if (preview.videoWidth) take(shown(preview));
    } catch (error) {
      failed(error);
    }
    preview.requestVideoFrameCallback(next);
  };
  preview.requestVideoFrameCallback(next);
  return () => {
    stopped = true;
  };
}

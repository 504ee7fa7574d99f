// Reads the frames of a camera: by a track processor if the browser has one, otherwise from the preview.

/**
 * The current picture of the preview, for browsers without `VideoFrame`.
 * @typedef {{preview: HTMLVideoElement, displayWidth: number, displayHeight: number, close: () => void}} PreviewFrame
 */
/** @typedef {VideoFrame | PreviewFrame} Frame */

/**
 * Calls `take` with every frame, which it must close, until stopped.
 * @param {MediaStreamTrack} track
 * @param {HTMLVideoElement} preview that shows the track
 * @param {(frame: Frame) => void} take
 * @param {(error: Error) => void} failed called if `take` throws, after which frames continue, or if the camera cannot be read
 * @returns {() => void} stops reading
 */
export function eachFrame(track, preview, take, failed) {
  const Processor = /** @type {any} */ (globalThis).MediaStreamTrackProcessor;
  /** @param {Frame} frame */
  const guarded = (frame) => {
    try {
      take(frame);
    } catch (error) {
      // an open frame would block the camera
      frame.close();
      failed(error);
    }
  };
  return Processor ? fromProcessor(new Processor({ track, maxBufferSize: 1 }), guarded, failed) : fromPreview(preview, guarded, failed);
}

/**
 * The drawable picture of a frame.
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
function fromProcessor({ readable }, take, failed) {
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
  // the end of the track is not an error
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
function previewFrame(preview) {
  if (globalThis.VideoFrame) return new VideoFrame(preview, { timestamp: Math.round(performance.now() * 1000) });
  return { preview, displayWidth: preview.videoWidth, displayHeight: preview.videoHeight, close: () => {} };
}

/**
 * @param {HTMLVideoElement} preview
 * @param {(frame: Frame) => void} take
 * @param {(error: Error) => void} failed
 */
function fromPreview(preview, take, failed) {
  let stopped = false;
  const next = () => {
    if (stopped) return;
    try {
      if (preview.videoWidth) take(previewFrame(preview));
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

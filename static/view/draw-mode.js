// How a scene is drawn: overlay, mono or stereo, with or without depth of field.

import { DepthOfField } from '../draw/depth-of-field/aperture.js';
import { TileErrors } from '../draw/tile-errors.js';
import { EYES, eyes, framed } from './camera.js';

/** @import { SceneHead } from '../decode/scene.js' */
/** @import { WebGlRenderer } from '../draw/webgl.js' */
/** @import { WebGpuRenderer } from '../draw/webgpu.js' */
/** @import { Frame, Pose } from './camera.js' */

/**
 * A view to draw: the pose, the head of the scene, the disparity that views rotate about, and the part of the photo that the picture shows.
 * @typedef {{pose: Pose, head: SceneHead, pivot: number, frame: Frame}} Seen
 */
/** @typedef {WebGpuRenderer | WebGlRenderer} Renderer */

/** Overlays that can be drawn over the scene. */
export const OVERLAYS = Object.freeze(['none', 'depth', 'tiles', 'planes', 'error']);

export class DrawMode {
  overlay = 'none';
  /** Layout of both eyes' views (camera.js), or '' for one view. */
  stereo = '';
  /** Distance between the eyes, in units of the nearest distance. */
  eyeDistance = EYES;
  /** Whether the last picture's eyes were closer together than that. */
  narrowed = false;
  depthOfField = new DepthOfField();
  #errors;

  /** @param {string | undefined} report address of the photo's report, if there is one */
  constructor(report) {
    this.#errors = new TileErrors(report);
  }

  /**
   * Sets a renderer's overlay; throws if the report cannot be loaded.
   * @param {Renderer | null} renderer
   */
  async prepare(renderer) {
    if (this.overlay === 'error') this.#errors.want();
    if (!renderer) return;
    renderer.overlay = Math.max(0, OVERLAYS.indexOf(this.overlay));
    await this.#errors.show(renderer);
    this.depthOfField.restart();
  }

  /**
   * Draws on the canvas of a renderer; points at disparity `pivot` appear at the depth of the screen. Returns the count of passes.
   * @param {Renderer} renderer
   * @param {Seen & {canvas: {width: number, height: number}, moving: boolean}} seen
   */
  draw(renderer, { pose, head, canvas, pivot, moving, frame }) {
    const views = this.#views({ pose, head, pivot, frame }, canvas);
    if (this.depthOfField.on) return this.depthOfField.draw(renderer, views, pivot, moving);
    renderer.draw(views);
    return 1;
  }

  /**
   * @param {Seen} seen
   * @param {{width: number, height: number}} canvas
   */
  #views({ pose, head, pivot, frame }, canvas) {
    const { width, height } = canvas;
    this.narrowed = false;
    if (!this.stereo) return [{ pose, k: framed(head, canvas, frame), x: 0, width, height }];
    const { views, narrowed } = eyes(pose, head, canvas, pivot, frame, { layout: this.stereo, distance: this.eyeDistance });
    this.narrowed = narrowed;
    return views;
  }

  /** True if the scene is drawn without overlay, stereo or depth of field, so that finer parts may be drawn over it. */
  get plain() {
    return !this.stereo && !this.depthOfField.on && this.overlay === OVERLAYS[0];
  }

  /**
   * The mono view as a PNG file, in the photo's size if the whole photo is visible, otherwise in the screen's.
   * @param {Renderer} renderer
   * @param {Seen} seen
   * @param {{width: number, height: number} | null} size size of the picture if only a part is visible
   * @param {Renderer} [detail] renderer of the finer part over it
   */
  async picture(renderer, { pose, head, pivot, frame }, size, detail) {
    const { width, height } = size ?? head;
    const k = framed(head, { width, height }, frame);
    const pixels = this.depthOfField.on
      ? await this.depthOfField.pixels(renderer, { pose, k, x: 0, width, height }, pivot)
      : await renderer.readPixels(pose, k, width, height);
    const canvas = new OffscreenCanvas(width, height);
    const context = canvas.getContext('2d');
    context?.putImageData(new ImageData(pixels, width, height), 0, 0);
    if (detail)
      context?.drawImage(await createImageBitmap(new ImageData(await detail.readPixels(pose, k, width, height), width, height)), 0, 0);
    return canvas.convertToBlob({ type: 'image/png' });
  }

  /**
   * Disparity at a point of the view, in shares of its width and height from the upper left.
   * @param {Renderer} renderer
   * @param {Seen & {canvas: {width: number, height: number}}} seen
   * @param {number} x
   * @param {number} y
   */
  async disparityAt(renderer, { pose, head, frame, canvas }, x, y) {
    // a finger is no more precise than this
    const width = Math.min(head.width, 256);
    const height = Math.max(1, Math.round((canvas.height * width) / canvas.width));
    const { overlay } = renderer;
    renderer.overlay = OVERLAYS.indexOf('depth');
    const depth = renderer.readPixels(pose, framed(head, { width, height }, frame), width, height);
    // the draw calls are already submitted; only reading back is asynchronous
    renderer.overlay = overlay;
    const at = (/** @type {number} */ v, /** @type {number} */ side) => Math.max(0, Math.min(side - 1, Math.floor(v * side)));
    return (await depth)[(at(y, height) * width + at(x, width)) * 4] / 255;
  }
}

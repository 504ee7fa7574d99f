// How a scene is drawn: what lies over it, for one eye or two, through a pinhole or a lens.

import { DepthOfField } from '../draw/depth-of-field/aperture.js';
import { TileErrors } from '../draw/tile-errors.js';
import { eyes, framed } from './camera.js';

/** @import { SceneHead } from '../decode/scene.js' */
/** @import { WebGlRenderer } from '../draw/webgl.js' */
/** @import { WebGpuRenderer } from '../draw/webgpu.js' */
/** @import { Frame, Pose } from './camera.js' */

/**
 * What is seen: a pose, the head of the scene, the disparity that views turn about, and which part of the photo the picture shows.
 * @typedef {{pose: Pose, head: SceneHead, pivot: number, frame: Frame}} Seen
 */
/** @typedef {WebGpuRenderer | WebGlRenderer} Renderer */

/** Pictures that can be drawn over the scene. */
export const OVERLAYS = Object.freeze(['none', 'depth', 'tiles', 'planes', 'error']);

export class Display {
  overlay = 'none';
  stereo = false;
  depthOfField = new DepthOfField();
  #errors;

  /** @param {string | undefined} report address of the photo's report, where there is one */
  constructor(report) {
    this.#errors = new TileErrors(report);
  }

  /**
   * Brings a renderer up to what is to be drawn over the scene; throws where the report cannot be had.
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
   * Draws on the canvas of a renderer; what lies at disparity `pivot` stands in the screen. Gives back how often the scene was drawn.
   * @param {Renderer} renderer
   * @param {Seen & {canvas: {width: number, height: number}, moving: boolean}} seen
   */
  draw(renderer, { pose, head, canvas, pivot, moving, frame }) {
    const { width, height } = canvas;
    const views = this.stereo ? eyes(pose, head, canvas, pivot, frame) : [{ pose, k: framed(head, canvas, frame), x: 0, width, height }];
    if (this.depthOfField.on) return this.depthOfField.draw(renderer, views, pivot, moving);
    renderer.draw(views);
    return 1;
  }

  /** True where nothing but the photo as it is is drawn, through a pinhole and for one eye: then finer parts may lie over it. */
  get plain() {
    return !this.stereo && !this.depthOfField.on && this.overlay === OVERLAYS[0];
  }

  /**
   * The view as a PNG file, as it is drawn for one eye: in the photo's size where all of it is seen, else in that of the screen.
   * @param {Renderer} renderer
   * @param {Seen} seen
   * @param {{width: number, height: number} | null} closer size of the picture where only a part is seen
   * @param {Renderer} [detail] what draws finer parts over it
   */
  async picture(renderer, { pose, head, pivot, frame }, closer, detail) {
    const { width, height } = closer ?? head;
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
   * Disparity of what is seen at a place of the view, shares of its width and height from the upper left.
   * @param {Renderer} renderer
   * @param {Seen & {canvas: {width: number, height: number}}} seen
   * @param {number} x
   * @param {number} y
   */
  async disparityAt(renderer, { pose, head, frame, canvas }, x, y) {
    // as coarse as a finger
    const width = Math.min(head.width, 256);
    const height = Math.max(1, Math.round((canvas.height * width) / canvas.width));
    const { overlay } = renderer;
    renderer.overlay = OVERLAYS.indexOf('depth');
    const depth = renderer.readPixels(pose, framed(head, { width, height }, frame), width, height);
    // it is drawn by now, and only not read yet
    renderer.overlay = overlay;
    const at = (/** @type {number} */ v, /** @type {number} */ side) => Math.max(0, Math.min(side - 1, Math.floor(v * side)));
    return (await depth)[(at(y, height) * width + at(x, width)) * 4] / 255;
  }
}

// How a scene is drawn: what lies over it, for one eye or two, through a pinhole or a lens.

import { DepthOfField } from '../draw/depth-of-field/aperture.js';
import { TileErrors } from '../draw/tile-errors.js';
import { eyes, resized } from './camera.js';

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

  /** Brings a renderer up to what is to be drawn over the scene; throws where the report cannot be had. */
  async prepare(renderer) {
    if (this.overlay === 'error') this.#errors.want();
    if (!renderer) return;
    renderer.overlay = Math.max(0, OVERLAYS.indexOf(this.overlay));
    await this.#errors.show(renderer);
    this.depthOfField.restart();
  }

  /** Draws on the canvas of a renderer; what lies at disparity `pivot` stands in the screen. Gives back how often the scene was drawn. */
  draw(renderer, { pose, head, canvas, pivot, moving }) {
    const { width, height } = canvas;
    const views = this.stereo
      ? eyes(pose, head, canvas, pivot)
      : [{ pose, k: resized(head.intrinsics, head, canvas), x: 0, width, height }];
    if (this.depthOfField.on) return this.depthOfField.draw(renderer, views, pivot, moving);
    renderer.draw(views);
    return 1;
  }

  /** The view in the photo's size as a PNG file, as it is drawn for one eye. */
  async picture(renderer, { pose, head, pivot }) {
    const { width, height, intrinsics: k } = head;
    const pixels = this.depthOfField.on
      ? await this.depthOfField.pixels(renderer, { pose, k, width, height }, pivot)
      : await renderer.readPixels(pose, k, width, height);
    const canvas = new OffscreenCanvas(width, height);
    canvas.getContext('2d')?.putImageData(new ImageData(pixels, width, height), 0, 0);
    return canvas.convertToBlob({ type: 'image/png' });
  }

  /** Disparity of what is seen at a place of the view, shares of its width and height from the upper left. */
  async disparityAt(renderer, { pose, head }, x, y) {
    // as coarse as a finger
    const width = Math.min(head.width, 256);
    const height = Math.max(1, Math.round((head.height * width) / head.width));
    const { overlay } = renderer;
    renderer.overlay = OVERLAYS.indexOf('depth');
    const depth = renderer.readPixels(pose, resized(head.intrinsics, head, { width, height }), width, height);
    // it is drawn by now, and only not read yet
    renderer.overlay = overlay;
    const at = (v, side) => Math.max(0, Math.min(side - 1, Math.floor(v * side)));
    return (await depth)[(at(y, height) * width + at(x, width)) * 4] / 255;
  }
}

// Depth of field: the picture is the mean of views from all over the aperture, which blurs everything away from the focus.

import { SLOW_MS } from '../../view/adaptive-resolution.js';
import { shifted } from '../../view/camera.js';

/** @import { View } from '../../view/camera.js' */
/** @import { WebGlRenderer } from '../webgl.js' */
/** @import { WebGpuRenderer } from '../webgpu.js' */

/** Count of views in the mean of a picture at rest, and most views per frame. */
const SAMPLES = 64;
const STEP = 8;
/**
 * Radius of the aperture at full blur, in units of the nearest distance. Viewers go half-way to the border of the default view box by
 * themselves, so the aperture stays within it.
 */
const LARGEST = 0.015;

export class DepthOfField {
  /** Share of the largest aperture, 0 (a pinhole) to 1. */
  blur = 0;
  /** Disparity in focus, or null for the pivot. */
  /** @type {number | null} */
  focus = null;
  /** Time of one pass over the scene, ms. */
  cost = 0;
  #key = '';
  #done = 0;

  get on() {
    return this.blur > 0;
  }

  /** True while another frame would improve the picture. */
  get unfinished() {
    return this.on && this.#done < SAMPLES;
  }

  /** Restarts the mean with the next frame. */
  restart() {
    this.#done = 0;
    this.#key = '';
  }

  /**
   * Adds some of the aperture's views to the picture, restarting if anything has changed; does nothing if the picture is finished. Draws
   * without depth of field if that takes too long while moving. Returns how often the scene was drawn.
   * @param {WebGpuRenderer | WebGlRenderer} renderer
   * @param {View[]} views
   * @param {number} pivot
   * @param {boolean} moving
   */
  draw(renderer, views, pivot, moving) {
    const focus = this.focus ?? pivot;
    const key = JSON.stringify([views, renderer.overlay, this.blur, focus]);
    if (key !== this.#key) this.#done = 0;
    this.#key = key;
    const affordable = 2 * Math.floor(SLOW_MS / this.cost / 2);
    if (moving && affordable < 2) {
      renderer.draw(views);
      this.restart();
      return 1;
    }
    const before = this.#done;
    this.#done = Math.min(SAMPLES, before + Math.max(2, Math.min(STEP, affordable)));
    if (before === this.#done) return 0;
    const frames = [];
    for (let i = before; i < this.#done; i++) frames.push(views.map((view) => shifted(view, this.#offset(i), focus)));
    renderer.drawMean(frames, before);
    return frames.length;
  }

  /**
   * The finished picture of one view, premultiplied RGBA.
   * @param {WebGpuRenderer | WebGlRenderer} renderer
   * @param {View} view
   * @param {number} pivot
   */
  async pixels(renderer, view, pivot) {
    const sum = new Float32Array(view.width * view.height * 4);
    for (let i = 0; i < SAMPLES; i++) {
      const { pose, k, width, height } = shifted(view, this.#offset(i), this.focus ?? pivot);
      const part = await renderer.readPixels(pose, k, width, height);
      for (let j = 0; j < sum.length; j++) sum[j] += part[j];
    }
    return Uint8ClampedArray.from(sum, (v) => v / SAMPLES);
  }

  /** @param {number} i */
  #offset(i) {
    const radius = LARGEST * this.blur;
    return apertureAt(i).map((v) => v * radius);
  }
}

/** Steps of the R2 sequence, whose prefixes are evenly spread over a square. */
const [ALONG, AROUND] = [0.7548776662466927, 0.5698402909980532];

/**
 * Point `i` in the unit disc. Points come in opposite pairs, so an even number of them does not shift the picture.
 * @param {number} i
 */
export function apertureAt(i) {
  const pair = (i >> 1) + 0.5;
  const radius = Math.sqrt((ALONG * pair) % 1) * (i % 2 ? -1 : 1);
  const angle = 2 * Math.PI * ((AROUND * pair) % 1);
  return [radius * Math.cos(angle), radius * Math.sin(angle)];
}

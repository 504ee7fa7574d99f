// Depth of field, a lens instead of a pinhole: the picture is the mean of views from all over the aperture, so that what lies away from the focus blurs.
import { shifted } from '../../view/camera.js';
import { SLOW_MS } from '../../view/frame-pacing.js';

/** Views that a picture at rest is the mean of, and the most of them that one frame draws. */
const SAMPLES = 64;
const STEP = 8;
/** Radius of the aperture at full blur, in units of the nearest distance; half the usual view box, so nothing beyond it is seen. */
const LARGEST = 0.015;

export class DepthOfField {
  /** Share of the largest aperture, 0 (a pinhole) to 1. */
  blur = 0;
  /** Disparity of what is sharp, or null for what views turn about. */
  focus = null;
  /** Time to draw the scene once, ms. */
  cost = 0;
  #key = '';
  #done = 0;

  get on() {
    return this.blur > 0;
  }

  /** True while the picture gets better with another frame. */
  get unfinished() {
    return this.on && this.#done < SAMPLES;
  }

  /** The next frame starts anew. */
  restart() {
    this.#done = 0;
    this.#key = '';
  }

  /**
   * Draws some more of the aperture's views, anew where anything has changed since; nothing where the picture is done. Where that
   * takes too long while something moves, one through a pinhole. Gives back how often the scene was drawn.
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

  /** The finished picture of one view: premultiplied RGBA. */
  async pixels(renderer, view, pivot) {
    const sum = new Float32Array(view.width * view.height * 4);
    for (let i = 0; i < SAMPLES; i++) {
      const { pose, k, width, height } = shifted(view, this.#offset(i), this.focus ?? pivot);
      const part = await renderer.readPixels(pose, k, width, height);
      for (let j = 0; j < sum.length; j++) sum[j] += part[j];
    }
    return Uint8ClampedArray.from(sum, (v) => v / SAMPLES);
  }

  #offset(i) {
    const radius = LARGEST * this.blur;
    return apertureAt(i).map((v) => v * radius);
  }
}

/** Steps of the R2 sequence, whose every beginning is spread evenly over a square. */
const [ALONG, AROUND] = [0.7548776662466927, 0.5698402909980532];

/** Place `i` in the unit disc. Places come in opposite pairs: no even number of them moves the picture. */
export function apertureAt(i) {
  const pair = (i >> 1) + 0.5;
  const radius = Math.sqrt((ALONG * pair) % 1) * (i % 2 ? -1 : 1);
  const angle = 2 * Math.PI * ((AROUND * pair) % 1);
  return [radius * Math.cos(angle), radius * Math.sin(angle)];
}

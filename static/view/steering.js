// Where the camera is and what is drawn of the scene, as whoever has a viewer says it.

import { CameraControl } from '../input/camera-control.js';
import { Tilt } from '../input/gyroscope.js';
import { Motion } from '../input/motion.js';
import { Zoom } from '../input/zoom.js';
import { Display } from './display.js';

/** @import { Offset } from '../decode/scene.js' */
/** @import { Pose } from './camera.js' */
/** @import { Settings } from './settings.js' */

/** What a viewer is told; the viewer itself (viewer.js) draws what follows from it. `camera`, `lens`, `display` and `disposed` are for that one alone. */
export class Steering extends EventTarget {
  motion = new Motion();
  camera = new CameraControl(this.motion);
  lens = new Zoom();
  disposed = false;
  #tilt = new Tilt(this.motion, () => this.moved());
  #reduced = matchMedia('(prefers-reduced-motion: reduce)');

  /**
   * @param {{report?: string, offset?: Offset, settings?: object | Promise<object>}} options as the viewer has them
   */
  constructor({ report, offset, settings }) {
    super();
    this.display = new Display(report);
    this.motion.setIdle(!this.#reduced.matches);
    if (offset) this.motion.jump(offset);
    this.camera.touched = Boolean(offset);
    Promise.resolve(settings ?? {}).then((wanted) => this.obey(wanted));
    this.#reduced.addEventListener('change', this.#onReduced);
  }

  /** Draws now. */
  render() {}

  /** Draws from now on as long as anything moves. */
  wake() {}

  /** Fits the pictures into their place. */
  layout() {}

  /** Brings what draws up to what is to be drawn over the scene. */
  async prepare() {}

  dispose() {
    this.disposed = true;
    this.#tilt.set(false);
    this.#reduced.removeEventListener('change', this.#onReduced);
  }

  /**
   * As of every event target; the events are those named above.
   * @param {string} type
   * @param {(event: any) => void} listener to a CustomEvent
   * @param {AddEventListenerOptions | boolean} [options]
   */
  addEventListener(type, listener, options) {
    super.addEventListener(type, listener, options);
  }

  /** True while the camera moves by itself when left alone. */
  get idle() {
    return this.motion.idle;
  }

  /** What the photo's owner wants of the camera (settings.js). */
  get settings() {
    return this.camera.settings;
  }

  /** Changes it, now. */
  set settings(settings) {
    this.camera.touched = true;
    this.obey(settings);
  }

  /** @param {Settings} settings */
  obey(settings) {
    if (this.disposed) return;
    this.camera.obey(settings);
    if (settings.idle === 'none') this.setIdle(false);
    this.render();
    this.emit('pose');
  }

  /** What the photo itself goes of the view box where its owner does not say: shares. */
  get usual() {
    return this.camera.usual;
  }

  /** Where the camera is in the view box. */
  get place() {
    return this.camera.place;
  }

  /**
   * How large the photo is shown: 1 where all of it is seen, `own` where its pixels are those of the screen, `most` at the closest; `goal`
   * is what it is on its way to.
   */
  get zoom() {
    const { now, target, own, most } = this.lens;
    return { ...now, goal: target.scale, own, most };
  }

  /**
   * Comes closer by a factor, about a place given in CSS pixels from the middle.
   * @param {number} by
   * @param {{x: number, y: number}} [at]
   */
  zoomBy(by, at = { x: 0, y: 0 }) {
    this.lens.by(by, at);
    this.moved();
  }

  /** Half extents of where the camera goes, in units of the nearest distance, or null before that is known. */
  get limits() {
    return this.camera.limits;
  }

  /** Disparity that views turn about. */
  get pivot() {
    return this.camera.pivot;
  }

  /** @param {boolean} on */
  setIdle(on) {
    this.motion.setIdle(on);
    this.wake();
    this.emit('idle', { on });
  }

  /** What is drawn over the scene, one of `OVERLAYS` (display.js); only where the browser draws. */
  get overlay() {
    return this.display.overlay;
  }

  set overlay(name) {
    this.display.overlay = name;
    this.prepare();
    this.render();
  }

  /** A view for each eye, side by side; only where the browser draws. */
  get stereo() {
    return this.display.stereo;
  }

  set stereo(on) {
    this.display.stereo = on;
    this.layout();
  }

  /** How much blurs what lies away from the focus, 0 to 1; only where the browser draws. */
  get blur() {
    return this.display.depthOfField.blur;
  }

  set blur(share) {
    this.display.depthOfField.blur = Math.max(0, Math.min(1, share || 0));
    this.render();
  }

  /** Disparity of what is sharp. */
  get focus() {
    return this.display.depthOfField.focus ?? this.pivot;
  }

  /**
   * Lets the tilt of the device move the camera, or not; to be called from a tap. Throws where that is not allowed.
   * @param {boolean} on
   */
  setTilt(on) {
    return this.#tilt.set(on);
  }

  /** True while the tilt of the device moves the camera, which it does once the browser has allowed it. */
  get tilting() {
    return this.#tilt.on;
  }

  /** Eases back to where the photo was taken. */
  reset() {
    this.motion.home();
    this.lens.home();
    this.moved();
  }

  /**
   * Puts the camera at an offset in units of the view box.
   * @param {Offset} offset
   */
  moveTo(offset) {
    this.motion.jump(offset);
    this.moved();
  }

  /** Input came. */
  moved() {
    this.camera.moved();
    this.wake();
    this.emit('pose');
  }

  /**
   * Puts the camera at a pose exactly, and stops moving by itself; not limited to the view box.
   * @param {Partial<Pose>} pose
   */
  setPose(pose) {
    this.setIdle(false);
    this.camera.hold(pose);
    this.render();
    this.emit('pose');
  }

  /** The pose shown now. */
  get pose() {
    return this.camera.pose;
  }

  #onReduced = () => {
    if (this.#reduced.matches) this.setIdle(false);
  };

  /**
   * @param {string} type
   * @param {object} [detail]
   */
  emit(type, detail = {}) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }
}

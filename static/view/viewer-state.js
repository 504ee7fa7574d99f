// State of a viewer that its users read and set: camera, zoom, overlay, stereo and depth of field.

import { Motion } from '../input/camera-motion.js';
import { CameraPosition } from '../input/camera-position.js';
import { Tilt } from '../input/gyroscope.js';
import { Zoom } from '../input/zoom.js';
import { DrawMode } from './draw-mode.js';

/** @import { Offset } from '../decode/scene.js' */
/** @import { Pose } from './camera.js' */
/** @import { Settings } from './settings.js' */

/** Base class of `Viewer` (viewer.js), which draws. `camera`, `lens`, `drawMode` and `disposed` are internal to the two classes. */
export class ViewerState extends EventTarget {
  motion = new Motion();
  camera = new CameraPosition(this.motion);
  lens = new Zoom();
  disposed = false;
  #tilt = new Tilt(this.motion, () => this.moved());
  #reduced = matchMedia('(prefers-reduced-motion: reduce)');

  /**
   * @param {{report?: string, offset?: Offset, settings?: object | Promise<object>}} options those of `Viewer`
   */
  constructor({ report, offset, settings }) {
    super();
    this.drawMode = new DrawMode(report);
    this.motion.setIdle(!this.#reduced.matches);
    if (offset) this.motion.jump(offset);
    this.camera.touched = Boolean(offset);
    Promise.resolve(settings ?? {}).then((wanted) => this.applySettings(wanted));
    this.#reduced.addEventListener('change', this.#onReduced);
  }

  /** Draws now. */
  render() {}

  /** Starts drawing frames for as long as anything moves. */
  wake() {}

  /** Fits the pictures into the root element. */
  layout() {}

  /** Sets the renderer's overlay. */
  async prepare() {}

  dispose() {
    this.disposed = true;
    this.#tilt.set(false);
    this.#reduced.removeEventListener('change', this.#onReduced);
  }

  /**
   * As in `EventTarget`; viewer.js lists the events.
   * @param {string} type
   * @param {(event: any) => void} listener gets a CustomEvent
   * @param {AddEventListenerOptions | boolean} [options]
   */
  addEventListener(type, listener, options) {
    super.addEventListener(type, listener, options);
  }

  /** True if the camera moves by itself without input. */
  get idle() {
    return this.motion.idle;
  }

  /** The owner's settings of the camera (settings.js). */
  get settings() {
    return this.camera.settings;
  }

  /** Applies new settings at once. */
  set settings(settings) {
    this.camera.touched = true;
    this.applySettings(settings);
  }

  /** @param {Settings} settings */
  applySettings(settings) {
    if (this.disposed) return;
    this.camera.applySettings(settings);
    if (settings.idle === 'none') this.setIdle(false);
    this.render();
    this.emit('pose');
  }

  /** Default range of motion if the owner sets none, as shares of the view box. */
  get defaultShares() {
    return this.camera.defaultShares;
  }

  /** Position of the camera in the view box. */
  get place() {
    return this.camera.place;
  }

  /**
   * Current scale and centre of the zoom, and scales: 1 shows the whole photo, `own` shows one photo pixel per screen pixel, `most` is the
   * largest, and `goal` is the target of the easing.
   */
  get zoom() {
    const { now, target, own, most } = this.lens;
    return { ...now, goal: target.scale, own, most };
  }

  /**
   * Zooms by a factor about a point in CSS pixels from the centre.
   * @param {number} by
   * @param {{x: number, y: number}} [at]
   */
  zoomBy(by, at = { x: 0, y: 0 }) {
    this.lens.by(by, at);
    this.moved();
  }

  /** Half extents of the camera's range, in units of the nearest distance; null until the head of the scene is known. */
  get limits() {
    return this.camera.limits;
  }

  /** Pivot of the camera's rotation, a disparity. */
  get pivot() {
    return this.camera.pivot;
  }

  /** @param {boolean} on */
  setIdle(on) {
    this.motion.setIdle(on);
    this.wake();
    this.emit('idle', { on });
  }

  /** Overlay over the scene, one of `OVERLAYS` (draw-mode.js); has no effect if the server draws. */
  get overlay() {
    return this.drawMode.overlay;
  }

  set overlay(name) {
    this.drawMode.overlay = name;
    this.prepare();
    this.render();
  }

  /** How to draw a view for each eye: a stereo layout (camera.js), or '' for one view; has no effect if the server draws. */
  get stereo() {
    return this.drawMode.stereo;
  }

  set stereo(layout) {
    this.drawMode.stereo = layout;
    this.layout();
  }

  /** Distance between the eyes, in units of the nearest distance. */
  get eyeDistance() {
    return this.drawMode.eyeDistance;
  }

  set eyeDistance(distance) {
    this.drawMode.eyeDistance = distance;
    this.render();
  }

  /** True if the eyes are closer together than that, because more parallax would strain them. */
  get eyesNarrowed() {
    return this.drawMode.narrowed;
  }

  /** Strength of the depth of field, 0 to 1; has no effect if the server draws. */
  get blur() {
    return this.drawMode.depthOfField.blur;
  }

  set blur(share) {
    this.drawMode.depthOfField.blur = Math.max(0, Math.min(1, share || 0));
    this.render();
  }

  /** Disparity in focus. */
  get focus() {
    return this.drawMode.depthOfField.focus ?? this.pivot;
  }

  /**
   * Sets whether tilting the device moves the camera. Call it from a user gesture; throws if permission is denied.
   * @param {boolean} on
   */
  setTilt(on) {
    return this.#tilt.set(on);
  }

  /** True while tilting the device moves the camera, that is once the browser has granted permission. */
  get tilting() {
    return this.#tilt.on;
  }

  /** Returns the camera to where the photo was taken, with easing, and zooms out. */
  reset() {
    this.motion.home();
    this.lens.home();
    this.moved();
  }

  /**
   * Moves the camera to an offset in units of the view box, at once.
   * @param {Offset} offset
   */
  moveTo(offset) {
    this.motion.jump(offset);
    this.moved();
  }

  /** Handles input. */
  moved() {
    this.camera.moved();
    this.wake();
    this.emit('pose');
  }

  /**
   * Sets an exact pose, even outside the view box, and stops idle motion.
   * @param {Partial<Pose>} pose
   */
  setPose(pose) {
    this.setIdle(false);
    this.camera.holdPose(pose);
    this.render();
    this.emit('pose');
  }

  /** The current pose. */
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

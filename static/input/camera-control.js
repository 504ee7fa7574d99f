// Where the camera is: how far it was moved, within what the photo allows and its owner wants.
import { HOME, lookingAt, POSE_KEYS, pivotOf } from '../view/camera.js';
import { limitsOf } from '../view/limits.js';
import { limited, offsetOf } from '../view/settings.js';

/** @import { Offset, Scene, SceneHead } from '../decode/scene.js' */
/** @import { Motion } from './motion.js' */
/** @import { Pose } from '../view/camera.js' */
/** @import { Settings } from '../view/settings.js' */

/** Offsets for the server are rounded to this many steps over half the view box, so that its pictures can be kept. */
const STEPS = 12;

export class CameraControl {
  /**
   * Half extents of where the camera goes, in units of the nearest distance; known with the head of the scene.
   * @type {Offset | null}
   */
  limits = null;
  /** Disparity that views turn about. */
  pivot;
  /**
   * What the photo's owner wants (view/settings.js).
   * @type {Settings}
   */
  settings = {};
  /** True once somebody moved the camera: it does not go to its start any more. */
  touched = false;
  /** @type {SceneHead | null} */
  #head = null;
  /** @type {Scene | null} */
  #scene = null;
  /** @type {Pose | null} */
  #exact = null;

  /** @param {Motion} motion where it is moved, in units of the limits */
  constructor(motion) {
    this.motion = motion;
  }

  /** Takes over what is known of the scene: its head, and all of it once it is there. */
  know(head, scene) {
    this.#head = head;
    this.#scene = scene;
    this.#update();
  }

  obey(settings) {
    this.settings = settings;
    if (!this.touched && settings.start) this.motion.jump(offsetOf(settings.start, settings));
    this.#update();
  }

  #update() {
    if (!this.#head) return;
    this.limits = limited(limitsOf(this.#head), this.settings);
    this.pivot = this.settings.focus ?? pivotOf(this.#scene ?? this.#head);
  }

  /** Somebody moved it. */
  moved() {
    this.#exact = null;
    this.touched = true;
  }

  /** Holds a pose, within the limits or not, until it is moved; what is no number is as at home. */
  hold(pose) {
    const exact = { ...HOME };
    for (const key of POSE_KEYS) if (Number.isFinite(pose[key])) exact[key] = pose[key];
    this.#exact = exact;
  }

  /** True while it holds a pose. */
  get held() {
    return this.#exact !== null;
  }

  /** The pose now. */
  get pose() {
    return this.#exact ?? this.#at(this.motion.now);
  }

  /** The pose now, among few: for views that somebody else draws. */
  get coarsePose() {
    return this.#exact ?? this.#at(quantised(this.motion.now));
  }

  #at(offset) {
    if (!this.limits) return { ...HOME };
    const { x, y, z } = this.limits;
    return lookingAt(this.pivot, offset.x * x, offset.y * y, offset.z * z);
  }
}

/** An offset in units of the view box, on a grid. */
export function quantised(offset) {
  const snap = (v) => Math.round(v * STEPS) / STEPS;
  return { x: snap(offset.x), y: snap(offset.y), z: snap(offset.z) };
}

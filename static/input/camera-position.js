// Position of the camera, within the photo's limits and its owner's settings.
import { HOME, lookingAt, magnified, POSE_KEYS, WHOLE } from '../view/camera.js';
import { limitsOf } from '../view/camera-limits.js';
import { motionRangeOf, overscan } from '../view/motion-range.js';
import { offsetOf, placeOf, sharesOf } from '../view/settings.js';
import { STYLES } from './camera-motion.js';

/** @import { Offset, Scene, SceneHead } from '../decode/scene.js' */
/** @import { Motion } from './camera-motion.js' */
/** @import { Frame, Pose } from '../view/camera.js' */
/** @import { MotionRange } from '../view/motion-range.js' */
/** @import { Settings } from '../view/settings.js' */

/** Steps per half view box to which offsets for the server are rounded, so that its views can be cached. */
const STEPS = 12;

export class CameraPosition {
  /**
   * Half extents of the camera's range, in units of the nearest distance; null until the head of the scene is known.
   * @type {Offset | null}
   */
  limits = null;
  /**
   * Pivot of the camera's rotation, a disparity.
   * @type {number}
   */
  pivot = 0.35;
  /** Default range of motion if the owner sets none, as shares of the view box. */
  defaultShares = { x: 1, y: 1, z: 1 };
  /** Factor on the camera's offset: smaller when zoomed in, because zooming magnifies all motion. */
  damping = 1;
  /**
   * The owner's settings (view/settings.js).
   * @type {Settings}
   */
  settings = {};
  /** True once the camera was moved: settings no longer move it to their start position. */
  touched = false;
  /** @type {SceneHead | null} */
  #head = null;
  /** @type {Scene | null} */
  #scene = null;
  /** @type {MotionRange} */
  #range = { travel: { x: 0, y: 0, z: 0 }, pivot: 0.35, nearest: { x: 0.5, y: 0.5 } };
  /** @type {Scene | SceneHead | null} */
  #rangeSource = null;
  /** @type {Pose | null} */
  #exact = null;

  /** @param {Motion} motion its offsets are in units of the limits */
  constructor(motion) {
    this.motion = motion;
  }

  /**
   * Sets the scene: first its head, then all of it once decoded.
   * @param {SceneHead} head
   * @param {Scene | null} scene
   */
  setScene(head, scene) {
    this.#head = head;
    this.#scene = scene;
    this.#update();
  }

  /** @param {Settings} settings */
  applySettings(settings) {
    this.settings = settings;
    this.motion.setIdleStyle(settings.idle ?? STYLES[0], settings.speed ?? 1);
    this.#update(true);
  }

  /** Range of motion, as shares of the view box. */
  get shares() {
    return sharesOf(this.settings, this.defaultShares);
  }

  /** Position in the view box. */
  get place() {
    return placeOf(this.motion.now, this.shares);
  }

  #update(start = false) {
    if (!this.#head) return;
    const most = limitsOf(this.#head);
    const known = this.#scene ?? this.#head;
    // computed once per head and once per scene
    if (this.#rangeSource !== known) this.#range = motionRangeOf(known);
    const fresh = start || this.#rangeSource !== known;
    this.#rangeSource = known;
    const { travel, pivot } = this.#range;
    const share = (/** @type {'x' | 'y' | 'z'} */ axis) => (most[axis] > 0 ? Math.min(1, travel[axis] / most[axis]) : 1);
    this.defaultShares = { x: share('x'), y: share('y'), z: share('z') };
    this.limits = placeOf(most, this.shares);
    this.pivot = this.settings.focus ?? pivot;
    if (fresh && !this.touched && this.settings.start) this.motion.jump(offsetOf(this.settings.start, this.shares));
  }

  /**
   * `frame` adjusted to the camera's motion: slightly enlarged away from the home position, and magnified as the style of idle motion
   * requires.
   * @param {Frame} frame
   */
  framed(frame) {
    if (this.holdsPose || !this.#head || !this.limits) return frame;
    const { motion, pivot } = this;
    const most = overscan(this.#head, this.limits, pivot);
    const over = 1 + (most - 1) * motion.away;
    const back = 1 - motion.compensated * this.pose.tz * pivot;
    const about = magnified(frame, over * back, WHOLE);
    return magnified(about, motion.magnified, this.#range.nearest);
  }

  /** Records that the user moved the camera. */
  moved() {
    this.#exact = null;
    this.touched = true;
  }

  /**
   * Holds an exact pose, even beyond the limits, until the camera is moved; values that are not finite become 0.
   * @param {Partial<Pose>} pose
   */
  holdPose(pose) {
    const exact = { ...HOME };
    for (const key of POSE_KEYS) if (Number.isFinite(pose[key])) exact[key] = Number(pose[key]);
    this.#exact = exact;
  }

  /** True while it holds an exact pose. */
  get holdsPose() {
    return this.#exact !== null;
  }

  /** The current pose. */
  get pose() {
    return this.#exact ?? this.#at(this.motion.now);
  }

  /** The current pose, quantised: for views that the server draws. */
  get quantisedPose() {
    return this.#exact ?? this.#at(quantised(this.motion.now));
  }

  /** @param {Offset} offset */
  #at(offset) {
    if (!this.limits) return { ...HOME };
    const { x, y, z } = placeOf(this.limits, offset);
    return lookingAt(this.pivot, x * this.damping, y * this.damping, z * this.damping);
  }
}

/**
 * Rounds an offset in units of the view box to a grid.
 * @param {Offset} offset
 */
export function quantised(offset) {
  const snap = (/** @type {number} */ v) => Math.round(v * STEPS) / STEPS;
  return { x: snap(offset.x), y: snap(offset.y), z: snap(offset.z) };
}

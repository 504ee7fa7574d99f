// Where the camera is: how far it was moved, within what the photo allows and its owner wants.
import { HOME, lookingAt, magnified, POSE_KEYS, WHOLE } from '../view/camera.js';
import { limitsOf } from '../view/limits.js';
import { outlookOf, overscan } from '../view/outlook.js';
import { offsetOf, placeOf, sharesOf } from '../view/settings.js';
import { STYLES } from './motion.js';

/** @import { Offset, Scene, SceneHead } from '../decode/scene.js' */
/** @import { Motion } from './motion.js' */
/** @import { Frame, Pose } from '../view/camera.js' */
/** @import { Outlook } from '../view/outlook.js' */
/** @import { Settings } from '../view/settings.js' */

/** Offsets for the server are rounded to this many steps over half the view box, so that its pictures can be kept. */
const STEPS = 12;

export class CameraControl {
  /**
   * Half extents of where the camera goes, in units of the nearest distance; known with the head of the scene.
   * @type {Offset | null}
   */
  limits = null;
  /**
   * Disparity that views turn about.
   * @type {number}
   */
  pivot = 0.35;
  /** What the photo itself goes of the view box where its owner does not say: shares. */
  usual = { x: 1, y: 1, z: 1 };
  /** Of its way, what the camera goes: less where one looks closer, since everything moves as much farther. */
  damping = 1;
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
  /** @type {Outlook} */
  #outlook = { travel: { x: 0, y: 0, z: 0 }, pivot: 0.35, nearest: { x: 0.5, y: 0.5 } };
  /** @type {Scene | SceneHead | null} */
  #looked = null;
  /** @type {Pose | null} */
  #exact = null;

  /** @param {Motion} motion where it is moved, in units of the limits */
  constructor(motion) {
    this.motion = motion;
  }

  /**
   * Takes over what is known of the scene: its head, and all of it once it is there.
   * @param {SceneHead} head
   * @param {Scene | null} scene
   */
  know(head, scene) {
    this.#head = head;
    this.#scene = scene;
    this.#update();
  }

  /** @param {Settings} settings */
  obey(settings) {
    this.settings = settings;
    this.motion.wander(settings.idle ?? STYLES[0], settings.speed ?? 1);
    this.#update(true);
  }

  /** What the camera goes of the view box now. */
  get shares() {
    return sharesOf(this.settings, this.usual);
  }

  /** Where it is in the view box. */
  get place() {
    return placeOf(this.motion.now, this.shares);
  }

  #update(start = false) {
    if (!this.#head) return;
    const most = limitsOf(this.#head);
    const known = this.#scene ?? this.#head;
    // it does not change once the scene is there
    if (this.#looked !== known) this.#outlook = outlookOf(known);
    const fresh = start || this.#looked !== known;
    this.#looked = known;
    const { travel, pivot } = this.#outlook;
    const share = (/** @type {'x' | 'y' | 'z'} */ axis) => (most[axis] > 0 ? Math.min(1, travel[axis] / most[axis]) : 1);
    this.usual = { x: share('x'), y: share('y'), z: share('z') };
    this.limits = placeOf(most, this.shares);
    this.pivot = this.settings.focus ?? pivot;
    if (fresh && !this.touched && this.settings.start) this.motion.jump(offsetOf(this.settings.start, this.shares));
  }

  /**
   * The part of the photo that `frame` shows, as the camera moves: a little less where it is away from its place, and what the ways of
   * moving by itself do with the lens.
   * @param {Frame} frame
   */
  framed(frame) {
    if (this.held || !this.#head || !this.limits) return frame;
    const { motion, pivot } = this;
    const most = overscan(this.#head, this.limits, pivot);
    const over = 1 + (most - 1) * motion.away;
    const back = 1 - motion.compensated * this.pose.tz * pivot;
    const about = magnified(frame, over * back, WHOLE);
    return magnified(about, motion.magnified, this.#outlook.nearest);
  }

  /** Somebody moved it. */
  moved() {
    this.#exact = null;
    this.touched = true;
  }

  /**
   * Holds a pose, within the limits or not, until it is moved; what is no number is as at home.
   * @param {Partial<Pose>} pose
   */
  hold(pose) {
    const exact = { ...HOME };
    for (const key of POSE_KEYS) if (Number.isFinite(pose[key])) exact[key] = Number(pose[key]);
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

  /** @param {Offset} offset */
  #at(offset) {
    if (!this.limits) return { ...HOME };
    const { x, y, z } = placeOf(this.limits, offset);
    return lookingAt(this.pivot, x * this.damping, y * this.damping, z * this.damping);
  }
}

/**
 * An offset in units of the view box, on a grid.
 * @param {Offset} offset
 */
export function quantised(offset) {
  const snap = (/** @type {number} */ v) => Math.round(v * STEPS) / STEPS;
  return { x: snap(offset.x), y: snap(offset.y), z: snap(offset.z) };
}

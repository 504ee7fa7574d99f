// Camera motion: takes input or moves by itself when idle, stays within the limits, and eases towards the target.
// All offsets are in units of the limits' half extents: -1 to 1 on each axis.

/** @import { Offset } from '../decode/scene.js' */

const AXES = /** @type {('x' | 'y' | 'z')[]} */ (['x', 'y', 'z']);
/** Time constant of the critically damped spring, seconds. */
const EASE_S = 0.11;
/** Longest integration step of the spring, so that it does not jump after a pause. */
const MAX_STEP_S = 0.05;
const AT_REST = 1e-4;
/** Idle motion: period in seconds, extent, delay after the last input and fade-in time in seconds. */
const IDLE = { period: 8, far: 0.75, delay: 1.6, swell: 2.5 };
/** Styles of idle motion; films use the same ones (crates/render/src/animation.rs). */
export const STYLES = Object.freeze(['swing', 'orbit', 'dolly', 'dolly-zoom', 'zoom']);
/** Magnification of the lens at the end of `zoom`. */
const ZOOM = 1.3;
/** Time constant, seconds, and offset threshold of the slight enlargement of the photo while the camera is away from its home position. */
const FRAME_S = 0.5;
const AWAY = 0.02;
/** Beyond the limits, a drag has less and less effect; this exponent sets how sharp the knee is. */
const KNEE = 3;
const MAX_RAW = 2.5;

/**
 * Smoothly clamps any number to (-1, 1); close to the identity around 0.
 * @param {number} v
 */
export function softLimit(v) {
  return v / (1 + Math.abs(v) ** KNEE) ** (1 / KNEE);
}

/**
 * Inverse of `softLimit`, with `v` clamped to ±0.98.
 * @param {number} v
 */
function inverseSoftLimit(v) {
  const inside = Math.max(-0.98, Math.min(0.98, v || 0));
  return inside / (1 - Math.abs(inside) ** KNEE) ** (1 / KNEE);
}

export class Motion {
  constructor() {
    this.raw = { x: 0, y: 0, z: 0 };
    this.now = { x: 0, y: 0, z: 0 };
    this.speed = { x: 0, y: 0, z: 0 };
    this.idle = false;
    /** True while something other than the pointer sets the target, so that a hovering mouse does not interfere. */
    this.steered = false;
    this.idleTime = IDLE.delay;
    this.phase = 0;
    this.level = 0;
    /** Style of idle motion, one of `STYLES`, and its speed as a factor. */
    this.style = STYLES[0];
    this.rate = 1;
    /** 0 at the home position, 1 away from it; eased in between. */
    this.away = 0;
    /** True at the turning points of idle motion. */
    this.paused = false;
  }

  /** Offset of idle motion. */
  get #idleOffset() {
    const [sin, cos] = [Math.sin(this.phase) * IDLE.far, Math.cos(this.phase) * IDLE.far];
    const out = (1 - Math.cos(this.phase)) / 2;
    if (this.style === 'orbit') return { x: sin, y: cos, z: 0 };
    if (this.style === 'dolly') return { x: 0, y: 0, z: sin };
    if (this.style === 'dolly-zoom') return { x: 0, y: 0, z: -out };
    if (this.style === 'zoom') return { x: 0, y: 0, z: out };
    return { x: sin, y: 0.4 * IDLE.far * Math.sin(this.phase * 2), z: 0 };
  }

  /** Count of turning points passed. */
  get #turns() {
    const sideways = this.style === 'swing' || this.style === 'dolly';
    return Math.floor(this.phase / Math.PI + (sideways ? 0.5 : 0));
  }

  /** Magnification of the lens about the nearest things, on top of the camera's position. */
  get magnified() {
    return this.style === 'zoom' ? 1 + ((ZOOM - 1) * this.level * (1 - Math.cos(this.phase))) / 2 : 1;
  }

  /** Share of a move forward or back that the lens compensates for, 0 to 1. */
  get compensated() {
    return this.style === 'dolly-zoom' ? this.level : 0;
  }

  /**
   * Moves the target by an offset.
   * @param {number} dx
   * @param {number} dy
   * @param {number} dz
   */
  nudge(dx, dy, dz) {
    // bounded, because the camera would not react until a drag returns from far beyond the knee
    const bounded = (/** @type {number} */ v) => Math.max(-MAX_RAW, Math.min(MAX_RAW, v));
    this.raw = { x: bounded(this.raw.x + dx), y: bounded(this.raw.y + dy), z: bounded(this.raw.z + dz) };
    this.touched();
  }

  /**
   * Sets the target on x and y.
   * @param {number} x
   * @param {number} y
   */
  aim(x, y) {
    this.raw.x = x;
    this.raw.y = y;
    this.touched();
  }

  /** Returns to where the photo was taken. */
  home() {
    this.raw = { x: 0, y: 0, z: 0 };
    this.touched();
  }

  /**
   * Moves the camera to an offset at once, within the view box.
   * @param {Offset} offset
   */
  jump({ x, y, z }) {
    this.raw = { x: inverseSoftLimit(x), y: inverseSoftLimit(y), z: inverseSoftLimit(z) };
    this.now = { x: softLimit(this.raw.x), y: softLimit(this.raw.y), z: softLimit(this.raw.z) };
    this.speed = { x: 0, y: 0, z: 0 };
    this.touched();
  }

  /** Records input, which interrupts idle motion. */
  touched() {
    this.idleTime = 0;
  }

  /** @param {boolean} on */
  setIdle(on) {
    this.idle = on;
    this.idleTime = on ? IDLE.delay : 0;
  }

  /**
   * Sets style and speed of idle motion; ignores an unknown style.
   * @param {string | undefined} style
   * @param {number | undefined} rate speed factor, clamped to 0.25 to 4
   */
  setIdleStyle(style, rate) {
    if (style && STYLES.includes(style)) this.style = style;
    if (rate && rate > 0) this.rate = Math.min(4, Math.max(0.25, rate));
  }

  /**
   * Advances by `dt` seconds; returns true while anything moves, or idle motion is due.
   * @param {number} dt
   */
  step(dt) {
    this.idleTime += dt;
    const swinging = this.idle && this.idleTime > IDLE.delay;
    this.level = Math.max(0, Math.min(1, this.level + (swinging ? dt : -dt * 4) / IDLE.swell));
    const turns = this.#turns;
    if (this.level > 0) this.phase += (dt * 2 * Math.PI * this.rate) / IDLE.period;
    else this.phase = 0;
    this.paused = swinging && this.#turns !== turns;
    // the pointer's offset fades out as idle motion fades in
    const fade = 1 - this.level;
    const idle = this.#idleOffset;
    const target = {
      x: softLimit(this.raw.x) * fade + idle.x * this.level,
      y: softLimit(this.raw.y) * fade + idle.y * this.level,
      z: softLimit(this.raw.z) * fade + idle.z * this.level,
    };
    let moving = this.idle || this.level > 0;
    for (let left = Math.min(dt, 4 * MAX_STEP_S); left > 0; left -= MAX_STEP_S) {
      for (const axis of AXES) moving = this.#spring(axis, target[axis], Math.min(left, MAX_STEP_S)) || moving;
    }
    return this.#stepAway(dt) || moving;
  }

  /**
   * Eases `away`; returns true while it changes.
   * @param {number} dt
   */
  #stepAway(dt) {
    const gone = this.level > 0 || AXES.some((axis) => Math.abs(this.now[axis]) > AWAY || Math.abs(this.raw[axis]) > AWAY);
    const target = gone ? 1 : 0;
    this.away = target + (this.away - target) * Math.exp(-dt / FRAME_S);
    if (Math.abs(this.away - target) > 1e-3) return true;
    this.away = target;
    return false;
  }

  /**
   * @param {'x' | 'y' | 'z'} axis
   * @param {number} target
   * @param {number} dt
   */
  #spring(axis, target, dt) {
    const omega = 2 / EASE_S;
    const distance = this.now[axis] - target;
    const decay = Math.exp(-omega * dt);
    const pull = (this.speed[axis] + omega * distance) * dt;
    this.now[axis] = target + (distance + pull) * decay;
    this.speed[axis] = (this.speed[axis] - omega * pull) * decay;
    if (Math.abs(this.now[axis] - target) > AT_REST || Math.abs(this.speed[axis]) > AT_REST) return true;
    this.now[axis] = target;
    this.speed[axis] = 0;
    return false;
  }
}

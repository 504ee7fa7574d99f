// Where the camera should be: takes what moves it, or moves it by itself, keeps to the limits, and eases there.
// All offsets are in units of the limits' half extents: -1 to 1 on each axis.

/** @import { Offset } from '../decode/scene.js' */

const AXES = /** @type {('x' | 'y' | 'z')[]} */ (['x', 'y', 'z']);
/** Time constant of the critically damped spring, seconds. */
const EASE_S = 0.11;
/** Longest step that the spring takes at once, so that a pause does not make it jump. */
const MAX_STEP_S = 0.05;
const REST = 1e-4;
/** Idle motion: period, how far it goes, and how long after the last input it starts and how long it takes to swell. */
const IDLE = { period: 8, far: 0.75, delay: 1.6, swell: 2.5 };
/** Ways of moving by itself; films have the same (crates/render/src/animation.rs). */
export const STYLES = Object.freeze(['swing', 'orbit', 'dolly', 'dolly-zoom', 'zoom']);
/** How much narrower the lens looks at the end of `zoom`. */
const ZOOM = 1.3;
/** Time constant with which the frame gets a little closer where the camera leaves its place, seconds, and from which offset it does. */
const FRAME_S = 0.5;
const AWAY = 0.02;
/** Beyond the limits a drag goes on with less and less effect; this is how sharp the knee is. */
const KNEE = 3;
const MAX_RAW = 2.5;

/**
 * Smooth clamp of any number to (-1, 1); close to the identity around 0.
 * @param {number} v
 */
export function softLimit(v) {
  return v / (1 + Math.abs(v) ** KNEE) ** (1 / KNEE);
}

/**
 * The number that `softLimit` takes to `v`; short of the limits, where there is none.
 * @param {number} v
 */
function hardened(v) {
  const inside = Math.max(-0.98, Math.min(0.98, v || 0));
  return inside / (1 - Math.abs(inside) ** KNEE) ** (1 / KNEE);
}

export class Motion {
  constructor() {
    this.raw = { x: 0, y: 0, z: 0 };
    this.now = { x: 0, y: 0, z: 0 };
    this.speed = { x: 0, y: 0, z: 0 };
    this.idle = false;
    /** True while something else than the pointer aims: a mouse that only hovers must not fight it. */
    this.steered = false;
    this.quiet = IDLE.delay;
    this.phase = 0;
    this.level = 0;
    /** How it moves by itself, one of `STYLES`, and how fast: times the usual. */
    this.style = STYLES[0];
    this.rate = 1;
    /** From 0, at the photo's own place, to 1, away from it. */
    this.away = 0;
    /** True while it waits at a turn of idle motion. */
    this.paused = false;
  }

  /** Where idle motion has the camera now. */
  get #wander() {
    const [sin, cos] = [Math.sin(this.phase) * IDLE.far, Math.cos(this.phase) * IDLE.far];
    const way = (1 - Math.cos(this.phase)) / 2;
    if (this.style === 'orbit') return { x: sin, y: cos, z: 0 };
    if (this.style === 'dolly') return { x: 0, y: 0, z: sin };
    if (this.style === 'dolly-zoom') return { x: 0, y: 0, z: -way };
    if (this.style === 'zoom') return { x: 0, y: 0, z: way };
    return { x: sin, y: 0.4 * IDLE.far * Math.sin(this.phase * 2), z: 0 };
  }

  /** How often it has turned back. */
  get #turns() {
    const sideways = this.style === 'swing' || this.style === 'dolly';
    return Math.floor(this.phase / Math.PI + (sideways ? 0.5 : 0));
  }

  /** How much larger the lens shows the photo now than where the camera stands does, about the nearest things. */
  get magnified() {
    return this.style === 'zoom' ? 1 + ((ZOOM - 1) * this.level * (1 - Math.cos(this.phase))) / 2 : 1;
  }

  /** How much of a step forward or back the lens makes up for: 0 to 1. */
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
    // not far beyond the knee, or the way back would feel dead
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

  /** Back to where the photo was taken. */
  home() {
    this.raw = { x: 0, y: 0, z: 0 };
    this.touched();
  }

  /**
   * Puts the camera there at once, within the view box.
   * @param {Offset} offset
   */
  jump({ x, y, z }) {
    this.raw = { x: hardened(x), y: hardened(y), z: hardened(z) };
    this.now = { x: softLimit(this.raw.x), y: softLimit(this.raw.y), z: softLimit(this.raw.z) };
    this.speed = { x: 0, y: 0, z: 0 };
    this.touched();
  }

  /** Input came: idle motion waits. */
  touched() {
    this.quiet = 0;
  }

  /** @param {boolean} on */
  setIdle(on) {
    this.idle = on;
    this.quiet = on ? IDLE.delay : 0;
  }

  /**
   * Changes how it moves by itself; a style that is not known is left as it is.
   * @param {string | undefined} style
   * @param {number | undefined} rate times the usual speed
   */
  wander(style, rate) {
    if (style && STYLES.includes(style)) this.style = style;
    if (rate && rate > 0) this.rate = Math.min(4, Math.max(0.25, rate));
  }

  /**
   * Advances by `dt` seconds; true while anything moves or will move by itself.
   * @param {number} dt
   */
  step(dt) {
    this.quiet += dt;
    const swinging = this.idle && this.quiet > IDLE.delay;
    this.level = Math.max(0, Math.min(1, this.level + (swinging ? dt : -dt * 4) / IDLE.swell));
    const turns = this.#turns;
    if (this.level > 0) this.phase += (dt * 2 * Math.PI * this.rate) / IDLE.period;
    else this.phase = 0;
    this.paused = swinging && this.#turns !== turns;
    // where the pointer left the camera fades out as idle motion fades in
    const rest = 1 - this.level;
    const wander = this.#wander;
    const target = {
      x: softLimit(this.raw.x) * rest + wander.x * this.level,
      y: softLimit(this.raw.y) * rest + wander.y * this.level,
      z: softLimit(this.raw.z) * rest + wander.z * this.level,
    };
    let moving = this.idle || this.level > 0;
    for (let left = Math.min(dt, 4 * MAX_STEP_S); left > 0; left -= MAX_STEP_S) {
      for (const axis of AXES) moving = this.#spring(axis, target[axis], Math.min(left, MAX_STEP_S)) || moving;
    }
    return this.#leave(dt) || moving;
  }

  /**
   * Follows with `away`; true while it changes.
   * @param {number} dt
   */
  #leave(dt) {
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
    if (Math.abs(this.now[axis] - target) > REST || Math.abs(this.speed[axis]) > REST) return true;
    this.now[axis] = target;
    this.speed[axis] = 0;
    return false;
  }
}

// Moves the camera by tilting the device. The initial orientation is the centre; it drifts slowly, so that people can change posture.

/** @import { Motion } from './camera-motion.js' */

/** Tilt that moves the camera to the edge of the view box, degrees. */
const RANGE = 14;
/** Share of the offset by which the centre follows with each event. */
const DRIFT = 0.004;

/** Whether the device may have a gyroscope; only its events tell for sure. */
export function hasGyroscope() {
  return isSecureContext && 'DeviceOrientationEvent' in window && navigator.maxTouchPoints > 0;
}

export class Tilt {
  /**
   * Stops the tracking, or null. `#request` counts calls of `set`, because the permission prompt may take long.
   * @type {(() => void) | null}
   */
  #stop = null;
  #request = 0;

  /**
   * @param {Motion} motion
   * @param {() => void} wake called after each change
   */
  constructor(motion, wake) {
    this.motion = motion;
    this.wake = wake;
  }

  /** True while tilting moves the camera. */
  get on() {
    return this.#stop !== null;
  }

  /**
   * Starts or stops. Call it from a user gesture, because iOS asks for permission; throws if permission is denied.
   * @param {boolean} on
   */
  async set(on) {
    const request = ++this.#request;
    this.#stop?.();
    this.#stop = null;
    if (!on) return;
    // only Safari has requestPermission
    const permission = /** @type {{requestPermission?: () => Promise<string>}} */ (DeviceOrientationEvent);
    const answer = await permission.requestPermission?.();
    if (answer && answer !== 'granted') throw new Error('permission for the gyroscope was denied');
    if (request === this.#request) this.#stop = this.#follow();
  }

  #follow() {
    const { motion } = this;
    /** @type {number[] | null} */
    let centre = null;
    const onTilt = (/** @type {DeviceOrientationEvent} */ { beta, gamma }) => {
      if (beta === null || gamma === null) return;
      const now = screenTilt(beta, gamma, screen.orientation?.angle ?? 0);
      centre ??= now;
      // near the poles the angles jump by 360°, which must not move the camera
      const offset = [wrapped(now[0] - centre[0]), wrapped(now[1] - centre[1])];
      centre = [centre[0] + offset[0] * DRIFT, centre[1] + offset[1] * DRIFT];
      motion.aim(offset[0] / RANGE, offset[1] / RANGE);
      this.wake();
    };
    addEventListener('deviceorientation', onTilt);
    motion.steered = true;
    return () => {
      motion.steered = false;
      removeEventListener('deviceorientation', onTilt);
    };
  }
}

/**
 * Tilt to the right and down, relative to the orientation of the screen.
 * @param {number} beta
 * @param {number} gamma
 * @param {number} angle
 */
function screenTilt(beta, gamma, angle) {
  if (angle === 90) return [beta, -gamma];
  if (angle === 270) return [-beta, gamma];
  return angle === 180 ? [-gamma, -beta] : [gamma, beta];
}

/** @param {number} degrees */
function wrapped(degrees) {
  return ((((degrees + 180) % 360) + 360) % 360) - 180;
}

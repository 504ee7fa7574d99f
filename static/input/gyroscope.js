// Moves the camera by tilting the device. The first posture is the middle; it follows slowly, so that people may sit back.

/** @import { Motion } from './motion.js' */

/** Tilt that takes the camera to the end of the view box, degrees. */
const RANGE = 14;
/** Share of the way that the middle follows with each event. */
const DRIFT = 0.004;

/** Whether the device may have a gyroscope; only asking it tells for sure. */
export function hasGyroscope() {
  return isSecureContext && 'DeviceOrientationEvent' in window && navigator.maxTouchPoints > 0;
}

export class Tilt {
  /**
   * What stops it, or null; and the last wish, since the browser may take its time to allow it.
   * @type {(() => void) | null}
   */
  #stop = null;
  #wish = 0;

  /**
   * @param {Motion} motion
   * @param {() => void} wake called after each change
   */
  constructor(motion, wake) {
    this.motion = motion;
    this.wake = wake;
  }

  /** True while it moves the camera. */
  get on() {
    return this.#stop !== null;
  }

  /** Starts or stops. To be called from a tap, which is when iOS asks for permission; throws where that is not given. */
  async set(on) {
    const wish = ++this.#wish;
    this.#stop?.();
    this.#stop = null;
    if (!on) return;
    // only Safari has it
    const kind = /** @type {{requestPermission?: () => Promise<string>}} */ (DeviceOrientationEvent);
    const answer = await kind.requestPermission?.();
    if (answer && answer !== 'granted') throw new Error('the gyroscope is not allowed');
    if (wish === this.#wish) this.#stop = this.#follow();
  }

  #follow() {
    const { motion } = this;
    /** @type {number[] | null} */
    let middle = null;
    const onTilt = ({ beta, gamma }) => {
      if (beta === null || gamma === null) return;
      const now = turned(beta, gamma, screen.orientation?.angle ?? 0);
      middle ??= now;
      // near the poles the angles jump, which must not throw the camera
      const off = [wrapped(now[0] - middle[0]), wrapped(now[1] - middle[1])];
      middle = [middle[0] + off[0] * DRIFT, middle[1] + off[1] * DRIFT];
      motion.aim(off[0] / RANGE, off[1] / RANGE);
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

/** Tilt to the right and downwards as the screen is held. */
function turned(beta, gamma, angle) {
  if (angle === 90) return [beta, -gamma];
  if (angle === 270) return [-beta, gamma];
  return angle === 180 ? [-gamma, -beta] : [gamma, beta];
}

function wrapped(degrees) {
  return ((((degrees + 180) % 360) + 360) % 360) - 180;
}

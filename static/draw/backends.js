// Selects the drawing backend: WebGPU, then WebGL2. Each gets a second attempt after its device was lost.
import { findAdapter } from './device.js';
import { contextOf, WebGlRenderer, webGlSide } from './webgl.js';
import { leaveContext, takeContext } from './webgl-contexts.js';
import { WebGpuRenderer } from './webgpu.js';

/** @import { Scene } from '../decode/scene.js' */
/** @import { Holder } from './webgl-contexts.js' */

/** @typedef {'gpu' | 'webgl'} Mode */
/** @typedef {{mode: Mode, renderer: WebGpuRenderer | WebGlRenderer, canvas: HTMLCanvasElement}} Backend */

const ATTEMPTS = 2;

export class Backends {
  /** Detects the available backends. */
  static async find() {
    /** @type {Mode[]} */
    const modes = [];
    const sides = [];
    const adapter = await findAdapter();
    if (adapter) {
      modes.push('gpu');
      sides.push(adapter.limits.maxTextureDimension2D);
    }
    const side = webGlSide();
    if (side) {
      modes.push('webgl');
      sides.push(side);
    }
    return new Backends(modes, Math.min(...sides));
  }

  /**
   * @param {Mode[]} modes
   * @param {number} side of the largest texture that all of them can hold
   */
  constructor(modes, side) {
    this.side = side;
    this.left = modes.map((mode) => ({ mode, attempts: ATTEMPTS }));
    this.reason = 'This browser has neither WebGPU nor WebGL.';
  }

  get any() {
    return this.left.length > 0;
  }

  /** The context of the last backend was given back to another viewer: that attempt did not fail. */
  givenBack() {
    this.left[0].attempts++;
  }

  /**
   * Creates the best backend left, with a new canvas, because a canvas cannot change its context; `wait` if other viewers use all contexts.
   * @param {Scene} scene
   * @param {(reason: string) => void} onLost called if the device is lost
   * @param {Holder} holder of the WebGL2 context, if the backend needs one
   * @returns {Promise<Backend | 'wait' | null>}
   */
  async next(scene, onLost, holder) {
    while (this.any) {
      const [backend] = this.left;
      if (backend.mode === 'webgl' && backend.attempts > 0 && !takeContext(holder)) return 'wait';
      if (backend.attempts-- > 0) {
        try {
          const canvas = document.createElement('canvas');
          const lost = (/** @type {{message: string}} */ { message }) => {
            this.reason = message || 'The graphics device was lost.';
            leaveContext(holder);
            onLost(this.reason);
          };
          const renderer = await (backend.mode === 'gpu' ? WebGpuRenderer.create(scene, lost) : WebGlRenderer.create(canvas, scene, lost));
          return { mode: backend.mode, renderer, canvas };
        } catch (error) {
          this.reason = error.message;
          leaveContext(holder);
        }
      }
      this.left.shift();
    }
    return null;
  }
}

/**
 * Draws another scene on a transparent canvas, to be placed over one that `mode` draws.
 * @param {Mode} mode
 * @param {Scene} scene
 * @param {() => void} onLost
 */
export async function drawnOver(mode, scene, onLost) {
  const canvas = document.createElement('canvas');
  if (mode === 'webgl') contextOf(canvas, true);
  const renderer = await (mode === 'gpu' ? WebGpuRenderer.create(scene, onLost) : WebGlRenderer.create(canvas, scene, onLost));
  renderer.attach(canvas, true);
  return { renderer, canvas };
}

// The photo in a headset, by WebXR: it stands around the place where it was taken, and the head moves within the view box.

import { WebGlRenderer } from '../draw/webgl.js';
import { anglesOf, EYES, HOME } from '../view/camera.js';
import { softLimit } from './motion.js';

/** @import { Scene } from '../decode/scene.js' */

/** Distance of a person's eyes in metres: it is that of the other stereo views, which gives the unit of length its metres. */
const EYES_M = 0.063;
const UNITS_PER_METRE = EYES / EYES_M;
const FAR_M = 1000;

/** Whether there is a headset to look into. */
export async function hasHeadset() {
  try {
    return Boolean(await navigator.xr?.isSessionSupported('immersive-vr'));
  } catch {
    return false;
  }
}

export class Headset {
  /**
   * Shows a scene in the headset; to be called from a tap.
   * @param {Scene} scene
   * @param {{x: number, y: number, z: number}} limits half extents of the view box
   * @param {() => void} onEnd called once when it is over, whoever ended it
   * @throws where the browser or the person does not allow it
   */
  static async enter(scene, limits, onEnd) {
    if (!navigator.xr) throw new Error('the browser knows no headsets');
    const session = await navigator.xr.requestSession('immersive-vr');
    const headset = new Headset(session, limits, onEnd);
    try {
      await headset.#build(scene);
    } catch (error) {
      await headset.end();
      throw error;
    }
    return headset;
  }

  constructor(session, limits, onEnd) {
    this.session = session;
    this.limits = limits;
    this.frames = 0;
    /** What the eyes saw last. */
    this.views = [];
    session.addEventListener('end', () => {
      this.session = null;
      this.renderer?.dispose();
      onEnd();
    });
  }

  async #build(scene) {
    this.renderer = await WebGlRenderer.create(document.createElement('canvas'), scene, () => this.end());
    const { gl } = this.renderer;
    await gl.makeXRCompatible();
    this.layer = new XRWebGLLayer(this.session, gl);
    await this.session.updateRenderState({ baseLayer: this.layer, depthFar: FAR_M });
    this.space = await this.session.requestReferenceSpace('local');
    this.session.requestAnimationFrame(this.#frame);
  }

  /** @type {XRFrameRequestCallback} */
  #frame = (_, frame) => {
    const { renderer, layer, space } = this;
    if (!this.session || !renderer || !layer || !space || renderer.disposed) return;
    this.session.requestAnimationFrame(this.#frame);
    const seen = frame.getViewerPose(space);
    if (!seen) return;
    const none = { x: 0, y: 0, width: 0, height: 0 };
    this.views = seen.views.map((view) => eyeView(view, seen.transform, this.limits, layer.getViewport(view) ?? none));
    renderer.draw(this.views, layer.framebuffer);
    this.frames++;
  };

  async end() {
    await this.session?.end().catch(() => {});
  }
}

/**
 * One eye's view as renderers take it. WebXR has y up and z backward; here y is down and z forward.
 * @param {XRView} view
 * @param {XRRigidTransform} head
 */
export function eyeView(view, head, limits, { x, y, width, height }) {
  const turned = [1, -1, -1];
  const at = view.transform.matrix;
  const axes = [0, 1, 2];
  const c = axes.flatMap((i) => axes.map((j) => at[j * 4 + i] * turned[i] * turned[j]));
  const place = ['x', 'y', 'z'].map((axis, i) => {
    const middle = head.position[axis] * turned[i] * UNITS_PER_METRE;
    const apart = (view.transform.position[axis] - head.position[axis]) * turned[i] * UNITS_PER_METRE;
    return limits[axis] * softLimit(middle / limits[axis] || 0) + apart;
  });
  const p = view.projectionMatrix;
  const k = { fx: (width / 2) * p[0], fy: (height / 2) * p[5], cx: (width / 2) * (1 - p[8]), cy: (height / 2) * (1 + p[9]) };
  return { pose: { ...HOME, tx: place[0], ty: place[1], tz: place[2], ...anglesOf(c) }, k, x, y, width, height };
}

// Shows the photo in a headset, by WebXR: the viewer stands where the photo was taken, and the head moves within the view box.

import { WebGlRenderer } from '../draw/webgl.js';
import { anglesOf, EYES, HOME } from '../view/camera.js';
import { softLimit } from './camera-motion.js';

/** @import { Offset, Scene } from '../decode/scene.js' */
/** @import { View } from '../view/camera.js' */

/** Distance between a person's eyes, metres. It equals EYES of the other stereo views, which defines the scale of the scene. */
const EYES_M = 0.063;
const UNITS_PER_METRE = EYES / EYES_M;
const FAR_M = 1000;

/** Whether a headset is available. */
export async function hasHeadset() {
  try {
    return Boolean(await navigator.xr?.isSessionSupported('immersive-vr'));
  } catch {
    return false;
  }
}

export class Headset {
  /**
   * Shows a scene in the headset. Call it from a user gesture.
   * @param {Scene} scene
   * @param {{x: number, y: number, z: number}} limits half extents of the view box
   * @param {() => void} onEnd called once when the session ends
   * @throws if the browser or the user does not allow it
   */
  static async enter(scene, limits, onEnd) {
    if (!navigator.xr) throw new Error('the browser does not support WebXR');
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

  /**
   * @param {XRSession} session
   * @param {Offset} limits
   * @param {() => void} onEnd
   */
  constructor(session, limits, onEnd) {
    /** @type {XRSession | null} */
    this.session = session;
    this.limits = limits;
    this.frames = 0;
    /** The views of the last frame. */
    /** @type {View[]} */
    this.views = [];
    session.addEventListener('end', () => {
      this.session = null;
      this.renderer?.dispose();
      onEnd();
    });
  }

  /** @param {Scene} scene */
  async #build(scene) {
    const { session } = this;
    if (!session) throw new Error('the headset session has ended');
    this.renderer = await WebGlRenderer.create(document.createElement('canvas'), scene, () => this.end());
    const { gl } = this.renderer;
    await gl.makeXRCompatible();
    this.layer = new XRWebGLLayer(session, gl);
    await session.updateRenderState({ baseLayer: this.layer, depthFar: FAR_M });
    this.space = await session.requestReferenceSpace('local');
    session.requestAnimationFrame(this.#frame);
  }

  /** @type {XRFrameRequestCallback} */
  #frame = (_, frame) => {
    const { renderer, layer, space } = this;
    if (!this.session || !renderer || !layer || !space || renderer.disposed) return;
    this.session.requestAnimationFrame(this.#frame);
    const viewerPose = frame.getViewerPose(space);
    if (!viewerPose) return;
    const noViewport = { x: 0, y: 0, width: 0, height: 0 };
    this.views = viewerPose.views.map((view) => eyeView(view, viewerPose.transform, this.limits, layer.getViewport(view) ?? noViewport));
    const { framebuffer, framebufferWidth: width, framebufferHeight: height } = layer;
    renderer.draw(this.views, { framebuffer, width, height });
    this.frames++;
  };

  async end() {
    await this.session?.end().catch(() => {});
  }
}

/**
 * One eye's view for the renderers. In WebXR, y points up and z backward; here y points down and z forward.
 * @param {XRView} view
 * @param {XRRigidTransform} head
 * @param {Offset} limits
 * @param {{x: number, y: number, width: number, height: number}} viewport
 * @returns {View}
 */
export function eyeView(view, head, limits, { x, y, width, height }) {
  const signs = [1, -1, -1];
  const at = view.transform.matrix;
  const axes = [0, 1, 2];
  const c = axes.flatMap((i) => axes.map((j) => at[j * 4 + i] * signs[i] * signs[j]));
  const names = /** @type {('x' | 'y' | 'z')[]} */ (['x', 'y', 'z']);
  const place = names.map((axis, i) => {
    const centre = head.position[axis] * signs[i] * UNITS_PER_METRE;
    const eyeOffset = (view.transform.position[axis] - head.position[axis]) * signs[i] * UNITS_PER_METRE;
    return limits[axis] * softLimit(centre / limits[axis] || 0) + eyeOffset;
  });
  const p = view.projectionMatrix;
  const k = { fx: (width / 2) * p[0], fy: (height / 2) * p[5], cx: (width / 2) * (1 - p[8]), cy: (height / 2) * (1 + p[9]) };
  return { pose: { ...HOME, tx: place[0], ty: place[1], tz: place[2], ...anglesOf(c) }, k, x, y, width, height };
}

// Shows a room in the viewer: the frames from its worker (live/worker.js), in three dimensions or as plain video.

/** @import { SceneHead } from '../decode/scene.js' */
/** @import { Instances } from '../draw/instances.js' */
/** @import { Cells } from '../live/tile-atlas.js' */
/** @import { Stage } from './stage.js' */
/** @import { Viewer } from './viewer.js' */

/**
 * A room to watch: a function that starts its worker, its address and its token.
 * @typedef {{start: () => Worker, address: string, token: string}} Live
 */
/**
 * Private parts of the viewer: its DOM, and a function that draws the scene on the best available backend. `replaces`: whether another
 * scene was drawn before.
 * @typedef {{stage: Stage, draw: (replaces: boolean) => Promise<void>}} Internals
 */

/** Time without frames after which the room counts as paused. */
const PAUSE_MS = 500;

export class LiveView {
  /** @type {Viewer} */
  #viewer;
  /** @type {Internals} */
  #internals;
  /**
   * Updates that are not drawn yet.
   * @type {{instances: Instances | null, cells: Cells}[]}
   */
  #updates = [];
  /** True if an animation frame is requested. */
  #requested = false;
  /** True while plain video is shown until there is a scene. */
  #early = false;
  /** True if the renderer of an earlier scene was disposed. */
  #rendererGone = false;
  /** Serialises the drawing of scenes. */
  #drawing = Promise.resolve();
  /** Arrival of the last frame, `performance.now()`. */
  #lastFrame = Number.NEGATIVE_INFINITY;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #pause;

  /**
   * @param {Viewer} viewer
   * @param {Internals} internals
   */
  constructor(viewer, internals) {
    [this.#viewer, this.#internals] = [viewer, internals];
  }

  dispose() {
    clearTimeout(this.#pause);
  }

  /** Whether frames are arriving. */
  get playing() {
    return performance.now() - this.#lastFrame < PAUSE_MS;
  }

  /**
   * Draws a room's new scene.
   * @param {Cells} cells
   */
  draw(cells) {
    const viewer = this.#viewer;
    const { scene } = viewer;
    this.#early = false;
    // in order, and only the newest scene
    this.#drawing = this.#drawing.then(async () => {
      if (viewer.disposed || scene !== viewer.scene) return;
      const before = viewer.renderer;
      // the backend must start over if it drew another scene
      const replaces = before !== null || this.#rendererGone;
      this.#rendererGone = false;
      await this.#internals.draw(replaces);
      before?.dispose();
      if (viewer.renderer) this.follow({ instances: null, cells });
    });
  }

  /**
   * Draws an update at the next screen refresh. In a hidden page there are no refreshes, so it gets no further frames.
   * @param {{instances: Instances | null, cells: Cells}} change
   */
  follow(change) {
    if (this.#viewer.disposed) return;
    this.#updates.push(change);
    this.#lastFrame = performance.now();
    clearTimeout(this.#pause);
    // the last picture is drawn at full resolution
    this.#pause = setTimeout(() => this.#viewer.layout(), PAUSE_MS);
    this.#request();
  }

  #request() {
    if (this.#requested) return;
    this.#requested = true;
    requestAnimationFrame(() => {
      this.#requested = false;
      // while the camera moves, its next step draws the update, so that each refresh draws once
      if (!this.#viewer.moving && this.applyUpdate()) this.#viewer.render();
      if (this.#updates.length) this.#request();
    });
  }

  /** Applies the next update to the renderer; returns false if there is none. */
  applyUpdate() {
    const { renderer, disposed } = this.#viewer;
    if (disposed || !renderer) this.#updates = [];
    const change = this.#updates.shift();
    if (!change || !renderer) return false;
    renderer.update(change);
    // the renderer has copied the texels
    const scratch = change.cells.data.buffer;
    this.#viewer.postToWorker({ drawn: true, scratch }, [scratch]);
    return true;
  }

  /**
   * Shows a frame as plain video, if no backend can draw the scene or there is no scene yet.
   * @param {VideoFrame | ImageBitmap} picture
   * @param {boolean} early whether there is no scene yet
   */
  showFlat(picture, early) {
    const viewer = this.#viewer;
    const { head } = viewer;
    if (!head || viewer.disposed) return picture.close();
    if (early) return this.#showEarly(picture, head);
    if (!viewer.canvas) {
      const canvas = document.createElement('canvas');
      [canvas.width, canvas.height] = [head.width, head.height];
      this.#internals.stage.canvas = canvas;
      viewer.mode = 'flat';
      viewer.setIdle(false);
      viewer.layout();
      viewer.emit('ready', { mode: 'flat' });
    }
    requestAnimationFrame(() => {
      viewer.canvas?.getContext('2d')?.drawImage(picture, 0, 0, head.width, head.height);
      picture.close();
      viewer.postToWorker({ drawn: true });
    });
  }

  /**
   * Shows a frame before there is a scene.
   * @param {VideoFrame | ImageBitmap} picture
   * @param {SceneHead} head
   */
  #showEarly(picture, head) {
    const viewer = this.#viewer;
    if (!this.#early || !viewer.canvas) {
      this.#early = true;
      // the renderer belongs to the room's previous scene
      if (viewer.renderer) this.#rendererGone = true;
      viewer.renderer?.dispose();
      viewer.renderer = null;
      const canvas = document.createElement('canvas');
      [canvas.width, canvas.height] = [head.width, head.height];
      this.#internals.stage.canvas = canvas;
      viewer.mode = 'flat';
      viewer.layout();
      viewer.emit('ready', { mode: 'flat', early: true });
    }
    const { canvas } = viewer;
    requestAnimationFrame(() => {
      if (this.#early) canvas?.getContext('2d')?.drawImage(picture, 0, 0, head.width, head.height);
      picture.close();
      viewer.postToWorker({ drawn: true });
    });
  }
}

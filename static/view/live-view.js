// A room in the viewer: its frames as they come from its worker (live/worker.js), drawn here or as plain video.

/** @import { SceneHead } from '../decode/scene.js' */
/** @import { Instances } from '../draw/instances.js' */
/** @import { Cells } from '../live/tile-atlas.js' */
/** @import { Stage } from './stage.js' */
/** @import { Viewer } from './viewer.js' */

/**
 * A room to watch: what starts its worker, its address and its token.
 * @typedef {{start: () => Worker, address: string, token: string}} Live
 */
/**
 * What of a viewer is no business of others: where its pictures lie, and to draw its scene on the best backend that can be had, `anew`
 * where another was drawn before.
 * @typedef {{stage: Stage, draw: (anew: boolean) => Promise<void>}} Inside
 */

/** A room of which no frame came for so long is at rest. */
const PAUSE_MS = 500;

export class LiveView {
  /** @type {Viewer} */
  #viewer;
  /** @type {Inside} */
  #inside;
  /**
   * Frames that are not shown yet.
   * @type {{instances: Instances | null, cells: Cells}[]}
   */
  #fresh = [];
  /** The next one is shown when the screen is refreshed. */
  #asked = false;
  /** The video is shown as it is until there is a scene. */
  #early = false;
  /** What drew the room before has gone since. */
  #anew = false;
  /** Scenes are drawn one after the other. */
  #redrawn = Promise.resolve();
  /** When the last frame came, by the page's clock. */
  #came = Number.NEGATIVE_INFINITY;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #pause;

  /**
   * @param {Viewer} viewer
   * @param {Inside} inside
   */
  constructor(viewer, inside) {
    [this.#viewer, this.#inside] = [viewer, inside];
  }

  dispose() {
    clearTimeout(this.#pause);
  }

  /** Whether frames come. */
  get plays() {
    return performance.now() - this.#came < PAUSE_MS;
  }

  /**
   * Draws a room's scene from its beginning.
   * @param {Cells} cells
   */
  draw(cells) {
    const viewer = this.#viewer;
    const { scene } = viewer;
    this.#early = false;
    // one after the other, and only the newest
    this.#redrawn = this.#redrawn.then(async () => {
      if (viewer.disposed || scene !== viewer.scene) return;
      const before = viewer.renderer;
      // what was drawn before was another scene
      const anew = before !== null || this.#anew;
      this.#anew = false;
      await this.#inside.draw(anew);
      before?.dispose();
      if (viewer.renderer) this.follow({ instances: null, cells });
    });
  }

  /**
   * Shows the next frame of a room when the screen is refreshed; a page that nobody sees asks for no more.
   * @param {{instances: Instances | null, cells: Cells}} change
   */
  follow(change) {
    if (this.#viewer.disposed) return;
    this.#fresh.push(change);
    this.#came = performance.now();
    clearTimeout(this.#pause);
    // the last picture is drawn whole
    this.#pause = setTimeout(() => this.#viewer.layout(), PAUSE_MS);
    this.#ask();
  }

  #ask() {
    if (this.#asked) return;
    this.#asked = true;
    requestAnimationFrame(() => {
      this.#asked = false;
      // while the camera moves, it is drawn with the camera's next step: once for each refresh
      if (!this.#viewer.moving && this.takeFresh()) this.#viewer.render();
      if (this.#fresh.length) this.#ask();
    });
  }

  /** Hands the next frame of a room to what draws it; false where there is none. */
  takeFresh() {
    const { renderer, disposed } = this.#viewer;
    if (disposed || !renderer) this.#fresh = [];
    const change = this.#fresh.shift();
    if (!change || !renderer) return false;
    renderer.update(change);
    // what draws it has copied it
    const spare = change.cells.data.buffer;
    this.#viewer.tell({ drawn: true, spare }, [spare]);
    return true;
  }

  /**
   * Shows a frame of a room as it is, where nothing can draw its scene, or there is none yet.
   * @param {VideoFrame | ImageBitmap} picture
   * @param {boolean} early there is none yet
   */
  showFlat(picture, early) {
    const viewer = this.#viewer;
    const { head } = viewer;
    if (!head || viewer.disposed) return picture.close();
    if (early) return this.#showEarly(picture, head);
    if (!viewer.canvas) {
      const canvas = document.createElement('canvas');
      [canvas.width, canvas.height] = [head.width, head.height];
      this.#inside.stage.canvas = canvas;
      viewer.mode = 'flat';
      viewer.setIdle(false);
      viewer.layout();
      viewer.emit('ready', { mode: 'flat' });
    }
    requestAnimationFrame(() => {
      viewer.canvas?.getContext('2d')?.drawImage(picture, 0, 0, head.width, head.height);
      picture.close();
      viewer.tell({ drawn: true });
    });
  }

  /**
   * Shows a frame of a room of which nothing is known but that.
   * @param {VideoFrame | ImageBitmap} picture
   * @param {SceneHead} head
   */
  #showEarly(picture, head) {
    const viewer = this.#viewer;
    if (!this.#early || !viewer.canvas) {
      this.#early = true;
      // of the room as it was before
      if (viewer.renderer) this.#anew = true;
      viewer.renderer?.dispose();
      viewer.renderer = null;
      const canvas = document.createElement('canvas');
      [canvas.width, canvas.height] = [head.width, head.height];
      this.#inside.stage.canvas = canvas;
      viewer.mode = 'flat';
      viewer.layout();
      viewer.emit('ready', { mode: 'flat', early: true });
    }
    const { canvas } = viewer;
    requestAnimationFrame(() => {
      if (this.#early) canvas?.getContext('2d')?.drawImage(picture, 0, 0, head.width, head.height);
      picture.close();
      viewer.tell({ drawn: true });
    });
  }
}

// The viewer: shows a photo at once, then the scene in three dimensions, and moves the camera.
//
//   const viewer = new Viewer(element, { atlas: '/v1/photos/ID/atlas', view: '/v1/photos/ID/view' });
//   viewer.addEventListener('ready', …)
//
// Events (detail): `progress` {received, total} · `photo` · `ready` {mode} · `mode` {mode, reason} · `idle` {on} · `pose` ·
// `frame` {ms} · `error` {message} · `live` what a room's worker says (live/worker.js). `mode` is `gpu` where the browser draws with
// WebGPU, `webgl` where it does with WebGL2, `served` where the server draws, `still` where nobody can and the photo is all there is,
// and `flat` where a room is shown as plain video. Where nothing here draws, a room is `flat` at the camera's own place, which the video
// shows as it is, and `served` away from it, as long as the server draws; without a decoder for its video it is `served` everywhere.

import { Decoder } from '../decode/start.js';
import { Backends } from '../draw/backends.js';
import { ServerViews } from '../draw/server-views.js';
import { insistOnContext, leaveContext, lendContext } from '../draw/webgl-contexts.js';
import { listen } from '../input/gestures.js';
import { fovX, resized } from './camera.js';
import { pixelRatio, setPixels } from './canvas-size.js';
import { Detail } from './detail.js';
import { FramePacing } from './frame-pacing.js';
import { LiveView } from './live-view.js';
import { Stage } from './stage.js';
import { Steering } from './steering.js';

/** @import { Scene, SceneHead } from '../decode/scene.js' */
/** @import { WebGlRenderer } from '../draw/webgl.js' */
/** @import { Holder } from '../draw/webgl-contexts.js' */
/** @import { WebGpuRenderer } from '../draw/webgpu.js' */
/** @import { Headset } from '../input/xr.js' */
/** @import { Display } from './display.js' */
/** @import { Live } from './live-view.js' */

/** How long idle motion rests at a turn where the machine is too slow to draw all pixels while it moves, ms. */
const REST_MS = 1500;

export class Viewer extends Steering {
  /** @type {Worker | Decoder | null} */
  #worker = null;
  #frameRequest = 0;
  #lastFrame = 0;
  /** @type {Backends | null} */
  #backends = null;
  #stage;
  #asleep = false;
  #pacing;
  /** @type {Detail | null} */
  #detail = null;
  /** @type {{width: number, height: number} | null} */
  #full = null;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #rest;
  /** @type {LiveView | null} */
  #live;
  #stopListening;
  #resizes;
  /** It has nothing to draw with now, and may have again. */
  #lent = false;
  /** A backend is being made ready. */
  #busy = false;
  /** What it is among those that share a page's WebGL2 contexts. @type {Holder} */
  #holder = {
    asleep: () => this.#asleep,
    busy: () => this.#busy,
    giveBack: () => this.#giveBack(),
    retry: () => this.#drawAgain(),
  };

  /**
   * @param {HTMLElement} root focusable element that takes the input and holds the pictures
   * @param {{atlas?: string, view?: string, report?: string, offset?: {x: number, y: number, z: number}, embedded?: () => boolean,
   *   live?: Live, settings?: object | Promise<object>, full?: Promise<{width?: number, height?: number} | undefined>}} options addresses
   *   of the container, of the views that the server draws and of the photo's report; where the camera starts, in units of the view box;
   *   whether the viewer is a part of a page that scrolls now; what the photo's owner wants (settings.js), which the camera's start given
   *   here overrules; the photo's own size, where the container is a smaller level of it; a room to watch in place of a container
   */
  constructor(root, options) {
    super(options);
    this.root = root;
    this.options = options;
    this.#pacing = new FramePacing(Boolean(options.live));
    this.#stage = new Stage(root);
    this.#live = options.live ? new LiveView(this, options.live, { stage: this.#stage, draw: (anew) => this.#draw(anew) }) : null;
    this.mode = 'loading';
    /** What shows the scene in a headset (input/xr.js) while one does, else null. */
    this.headset = /** @type {Headset | null} */ (null);
    this.scene = /** @type {Scene | null} */ (null);
    this.head = /** @type {SceneHead & {total: number} | null} */ (null);
    this.renderer = /** @type {WebGpuRenderer | WebGlRenderer | null} */ (null);
    this.serverViews = /** @type {ServerViews | null} */ (null);
    options.full?.then((size) => this.#knowFull(size));
    this.#stopListening = listen(root, this.motion, this.lens, {
      wake: () => this.moved(),
      toggleIdle: () => this.setIdle(!this.idle),
      embedded: options.embedded,
    });
    this.#resizes = new ResizeObserver(() => this.layout());
    this.#resizes.observe(root);
    document.addEventListener('visibilitychange', this.#onVisible);
    this.#start();
  }

  /** The picture of the photo, which lies below the scene. */
  get poster() {
    return this.#stage.poster;
  }

  /** What the scene is drawn on, or null. */
  get canvas() {
    return this.#stage.canvas;
  }

  /** True while another frame is to come. */
  get moving() {
    return this.#frameRequest !== 0;
  }

  /** Smoothed time of a frame in ms, or null before the first. */
  get frameMs() {
    return this.#pacing.ms;
  }

  async prepare() {
    try {
      await this.display.prepare(this.renderer);
    } catch (error) {
      this.emit('error', { message: error.message });
    }
    this.render();
  }

  /**
   * Makes sharp what is seen at a place of the canvas, shares of its width and height from the upper left.
   * @param {number} x
   * @param {number} y
   */
  async focusAt(x, y) {
    const { canvas } = this;
    const seen = this.#seen;
    if (!this.renderer || !seen || !canvas || this.stereo) return;
    this.display.depthOfField.focus = await this.display.disparityAt(this.renderer, { ...seen, canvas }, x, y);
    this.render();
  }

  /** Shows the scene in a headset; to be called from a tap. Throws where that is not allowed. */
  async enterHeadset() {
    if (this.headset || !this.scene || !this.limits) return;
    const { Headset } = await import('../input/xr.js');
    this.headset = await Headset.enter(this.scene, this.limits, () => {
      this.headset = null;
      this.asleep = false;
    });
    // nobody sees the page
    this.asleep = true;
  }

  /** The view at the present pose as a PNG file, in the photo's size; where only a part is seen, in that of the screen. */
  async picture() {
    const seen = this.#seen;
    if (!this.renderer || !seen) throw new Error('a picture can be taken only where the browser draws');
    const { width, height } = this.lens.size;
    const ratio = pixelRatio();
    const closer = this.lens.close ? { width: Math.round(width * ratio), height: Math.round(height * ratio) } : null;
    return this.display.picture(this.renderer, seen, closer, closer ? this.#detailed : undefined);
  }

  /** What is seen now, or null before the head of the scene is known. */
  get #seen() {
    const { pose, head, pivot, moving } = this;
    return head && { pose, head, pivot, moving, frame: this.camera.framed(this.lens.frame) };
  }

  /** True while nobody sees it: it draws nothing then. */
  get asleep() {
    return this.#asleep;
  }

  set asleep(on) {
    this.#asleep = on;
    if (on) {
      cancelAnimationFrame(this.#frameRequest);
      this.#frameRequest = 0;
      this.#live?.stop();
      lendContext(this.#holder);
    } else if (this.#lent) this.#drawAgain();
    else this.wake();
  }

  /** Gives its graphics context to another viewer: the photo is seen meanwhile. */
  #giveBack() {
    this.#lent = true;
    this.#detail?.dispose();
    this.#detail = null;
    this.renderer?.dispose();
    this.renderer = null;
    this.#stage.canvas = null;
    this.mode = 'loading';
    this.emit('mode', { mode: 'loading', reason: 'Another picture of the page is drawn.' });
  }

  /** Draws where that could not be had for a while. */
  #drawAgain() {
    this.#lent = false;
    // what a room showed is gone with the context
    if (this.options.live) this.tell({ again: true });
    else this.#draw();
  }

  moved() {
    insistOnContext(this.#holder);
    super.moved();
  }

  /** Draws now. */
  render() {
    const seen = this.#seen;
    if (!this.head || !seen || this.disposed) return;
    if (this.renderer?.context && this.canvas) {
      const { depthOfField } = this.display;
      const times = this.display.draw(this.renderer, { ...seen, canvas: this.canvas });
      this.#drawDetail({ ...seen, canvas: this.canvas });
      if (depthOfField.unfinished) this.wake();
      if (!times) return;
      const { detail } = this.#pacing;
      this.#pacing
        .measure(this.renderer, () => this.moving || this.#plays)
        .then((ms) => {
          if (ms === null) return;
          // drawn with the next frame
          if (this.#plays && this.#pacing.detail !== detail) this.wake();
          depthOfField.cost = ms / times;
          this.emit('frame', { ms: this.#pacing.ms });
        });
    } else if (this.mode === 'served' || this.mode === 'flat') this.#ask(this.head);
  }

  /**
   * Asks the server for what is seen now.
   * @param {SceneHead} head
   */
  #ask(head) {
    const views = this.#live ? this.#live.views() : this.serverViews;
    const ratio = pixelRatio();
    const { width, height } = this.lens.size;
    const size = { width: width * ratio, height: height * ratio };
    views?.show(this.camera.coarsePose, fovX(head.intrinsics, head.width), size, this.lens.frame);
  }

  /**
   * The view at the present pose as the server would draw it.
   * @returns {Promise<Uint8ClampedArray>} premultiplied RGBA
   */
  async readPixels(width = this.head?.width ?? 0, height = this.head?.height ?? 0) {
    if (!this.renderer || !this.head) throw new Error('pixels can be read only where the browser draws');
    return this.renderer.readPixels(this.pose, resized(this.head.intrinsics, this.head, { width, height }), width, height);
  }

  dispose() {
    super.dispose();
    cancelAnimationFrame(this.#frameRequest);
    clearTimeout(this.#rest);
    this.#detail?.dispose();
    this.#worker?.terminate();
    this.#stopListening();
    this.headset?.end();
    this.#resizes.disconnect();
    document.removeEventListener('visibilitychange', this.#onVisible);
    this.renderer?.dispose();
    leaveContext(this.#holder);
    this.serverViews?.dispose();
    this.#live?.dispose();
    this.#stage.dispose();
  }

  async #start() {
    this.#backends = await Backends.find();
    if (this.disposed) return;
    const { live } = this.options;
    const { any, side } = this.#backends;
    try {
      this.#worker = live ? live.start() : new Decoder();
    } catch (error) {
      return this.#fail(`The page allows no worker, without which no room can be watched: ${error.message}`);
    }
    this.#worker.onerror = (/** @type {{message: string}} */ { message }) => this.#fail(message || 'The decoder could not be started.');
    this.#worker.onmessage = (/** @type {MessageEvent} */ { data }) => this.#onWorker(data);
    if (live) this.#worker.postMessage({ watch: { address: live.address, token: live.token, side, flat: !any } });
    else this.#worker.postMessage({ url: this.options.atlas, photoOnly: !any, side });
  }

  /** @param {any} data posted by decode/worker.js or live/worker.js */
  #onWorker(data) {
    if (data.type === 'scene' || data.type === 'picture') this.#live?.decoded();
    if (data.type === 'progress') this.emit('progress', { received: data.received, total: data.total || this.head?.total || 0 });
    else if (data.type === 'head') {
      this.head = data.head;
      this.camera.know(data.head, null);
      this.#live?.begin(data.head);
      this.layout();
    } else if (data.type === 'photo') {
      this.#stage.showPhoto(data.blob);
      this.emit('photo');
      if (this.#backends && !this.#backends.any) this.#serve(this.#backends.reason);
    } else if (data.type === 'scene') {
      this.scene = data.scene;
      if (this.head) this.camera.know(this.head, this.scene);
      if (this.#live) return this.#live.draw(data.cells);
      this.#worker?.terminate();
      this.#draw();
    } else if (data.type === 'update') this.#live?.follow(data);
    else if (data.type === 'picture') this.#live?.showFlat(data.picture, data.early);
    else if (data.type === 'error') this.#fail(data.message);
    else if (data.state === 'unsupported' && this.head) this.#live?.serveAlone(this.head);
    else this.emit('live', data);
  }

  /**
   * Says something to a room's worker.
   * @param {object} message
   * @param {ArrayBuffer[]} transfer what it has from then on
   */
  tell(message, transfer = []) {
    this.#worker?.postMessage(message, transfer);
  }

  /**
   * The container cannot be had or read: views from the server are the last resort, where at least its head came.
   * @param {string} message
   */
  #fail(message) {
    if (this.mode !== 'loading') return;
    if (this.head) this.#serve(message);
    else {
      this.mode = 'failed';
      this.emit('error', { message });
    }
  }

  /**
   * Draws on the best backend that can be had.
   * @param {boolean} [anew] another scene than before
   */
  async #draw(anew = false) {
    if (anew) this.#backends = await Backends.find();
    if (!this.#backends || !this.scene) return;
    this.#busy = true;
    const backend = await this.#backends.next(this.scene, (reason) => this.#onLost(reason), this.#holder);
    this.#busy = false;
    if (backend === 'wait') {
      this.#lent = true;
      return;
    }
    if (this.disposed) leaveContext(this.#holder);
    if (this.disposed) return backend?.renderer.dispose();
    if (!backend) return this.#serve(this.#backends.reason);
    this.#detail?.dispose();
    this.#detail = null;
    this.#stage.canvas = backend.canvas;
    this.renderer = backend.renderer;
    this.mode = backend.mode;
    this.layout();
    this.renderer.attach(backend.canvas);
    this.prepare();
    this.render();
    this.wake();
    this.emit('ready', { mode: this.mode });
    lendContext(this.#holder);
  }

  /** @param {string} reason */
  #onLost(reason) {
    if (this.disposed) return;
    this.renderer = null;
    this.mode = 'loading';
    this.emit('mode', { mode: 'loading', reason });
    this.#drawAgain();
  }

  /** @param {string} reason */
  #serve(reason) {
    if (this.disposed) return;
    this.#stage.canvas = null;
    // a swing would ask the server without end
    this.setIdle(false);
    if (this.options.live) return this.tell({ flat: true });
    if (!this.options.view || !this.head) {
      this.mode = 'still';
      this.emit('mode', { mode: 'still', reason });
      this.emit('ready', { mode: 'still' });
      return;
    }
    this.serverViews = new ServerViews(this.poster, this.options.view, this.head, (error) =>
      this.emit('error', { message: error.message }),
    );
    this.mode = 'served';
    this.emit('mode', { mode: 'served', reason });
    this.layout();
    this.render();
    this.emit('ready', { mode: 'served' });
  }

  /** Whether frames of a room come. */
  get #plays() {
    return this.#live?.plays ?? false;
  }

  /**
   * Share of the pixels a side that is drawn: all at rest. Of a room that plays not fewer than its frames have, or half of them in motion.
   * @param {number} width in CSS pixels
   */
  #share(width) {
    const { detail } = this.#pacing;
    if (!this.#plays) return this.moving ? detail : 1;
    const own = Math.min(1, (this.head?.width ?? 0) / (width * pixelRatio()));
    return Math.max(detail, this.moving ? own / 2 : own);
  }

  /** Fits the pictures into the root, whole, in the photo's own shape. */
  layout() {
    if (!this.head || this.disposed) return;
    const fit = this.#stage.fit((this.head.width / this.head.height) * (this.stereo && this.renderer ? 2 : 1));
    if (!fit) return;
    this.lens.measure(this.#stage.room, fit, (this.#full ?? this.head).width / (fit.width * (devicePixelRatio || 1)));
    const { size, frame } = this.lens;
    this.#stage.lay(size, fit, frame, this.mode === 'served');
    if (this.canvas && this.renderer) {
      setPixels(this.canvas, size, this.#share(size.width), this.renderer.maxSide);
      if (!this.renderer.context) return;
    }
    this.render();
  }

  /** @param {{width?: number, height?: number} | undefined} size */
  #knowFull(size) {
    if (!size?.width || !size.height) return;
    this.#full = { width: size.width, height: size.height };
    this.layout();
  }

  /** What draws a finer part of what is in sight, where one does. */
  get #detailed() {
    return this.display.plain ? this.#detail?.shown?.renderer : undefined;
  }

  /**
   * Draws finer parts over the scene, and sees to those that are missing.
   * @param {Parameters<Display['draw']>[1]} seen
   */
  #drawDetail(seen) {
    const { canvas, head } = this;
    const { atlas } = this.options;
    if (!canvas || !head || !atlas || !this.#full || !this.#backends) return;
    if (!this.#detail && this.lens.close && (this.mode === 'gpu' || this.mode === 'webgl')) {
      const { mode } = this;
      const changed = () => this.render();
      this.#detail = new Detail({ atlas, mode, side: this.#backends.side, photo: this.#full, loaded: head, changed });
    }
    if (this.display.plain)
      this.#detail?.look(this.lens.frame, { width: this.lens.size.width * pixelRatio(), height: this.lens.size.height * pixelRatio() });
    const shown = this.#detailed && this.#detail?.shown;
    this.#stage.detail = shown ? shown.canvas : null;
    if (!shown) return;
    const { width, height } = canvas;
    if (shown.canvas.width !== width || shown.canvas.height !== height) [shown.canvas.width, shown.canvas.height] = [width, height];
    this.display.draw(shown.renderer, { ...seen, canvas: shown.canvas });
  }

  wake() {
    clearTimeout(this.#rest);
    if (this.#frameRequest || this.#asleep || this.disposed || this.mode === 'failed') return;
    this.#lastFrame = 0;
    this.#frameRequest = requestAnimationFrame((now) => this.#frame(now));
  }

  /** @param {number} now */
  #frame(now) {
    this.#frameRequest = 0;
    this.#live?.takeFresh();
    const dt = this.#lastFrame ? (now - this.#lastFrame) / 1000 : 1 / 60;
    if (this.mode === 'loading') return;
    const closing = this.lens.step(dt);
    // what is shown larger moves as much farther
    this.camera.damping = this.lens.now.scale ** -0.5;
    const moving = (!this.camera.held && this.motion.step(dt)) || closing;
    if (moving && !closing && this.motion.paused && this.#pacing.detail < 1) this.#rest = setTimeout(() => this.wake(), REST_MS);
    else if (moving) {
      this.#lastFrame = now;
      this.#frameRequest = requestAnimationFrame((next) => this.#frame(next));
    }
    this.layout();
  }

  #onVisible = () => {
    if (!document.hidden) this.wake();
    else this.#live?.stop();
  };
}

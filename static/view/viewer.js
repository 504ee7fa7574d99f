// The viewer: shows the photo first, then the scene in three dimensions, and moves the camera.
//
//   const viewer = new Viewer(element, { atlas: '/v1/photos/ID/atlas', view: '/v1/photos/ID/view' });
//   viewer.addEventListener('ready', …)
//
// Events (detail): `progress` {received, total} · `photo` · `ready` {mode} · `mode` {mode, reason} · `idle` {on} · `pose` ·
// `frame` {ms} · `error` {message} · `live` messages of a room's worker (live/worker.js).
//
// `mode` is `gpu` if the browser draws with WebGPU, `webgl` with WebGL2, `served` if the server draws, `still` if nothing can draw and
// only the photo is shown, and `flat` if a room is shown as plain video because the browser cannot draw it.

import { Decoder } from '../decode/start.js';
import { Backends } from '../draw/backends.js';
import { ServerViews } from '../draw/server-views.js';
import { insistOnContext, leaveContext, lendContext } from '../draw/webgl-contexts.js';
import { listen } from '../input/gestures.js';
import { AdaptiveResolution } from './adaptive-resolution.js';
import { columnsOf, fovX, resized } from './camera.js';
import { pixelRatio, setPixels } from './canvas-size.js';
import { Detail } from './detail.js';
import { LiveView } from './live-view.js';
import { Stage } from './stage.js';
import { ViewerState } from './viewer-state.js';

/** @import { Scene, SceneHead } from '../decode/scene.js' */
/** @import { WebGlRenderer } from '../draw/webgl.js' */
/** @import { Holder } from '../draw/webgl-contexts.js' */
/** @import { WebGpuRenderer } from '../draw/webgpu.js' */
/** @import { Headset } from '../input/xr.js' */
/** @import { DrawMode } from './draw-mode.js' */
/** @import { Live } from './live-view.js' */

/** Pause of idle motion at its turning points if the machine is too slow to draw all pixels in motion, ms. */
const TURN_PAUSE_MS = 1500;

export class Viewer extends ViewerState {
  /** @type {Worker | Decoder | null} */
  #worker = null;
  #frameRequest = 0;
  #lastFrame = 0;
  /** @type {Backends | null} */
  #backends = null;
  #stage;
  #asleep = false;
  #adaptive;
  /** @type {Detail | null} */
  #detail = null;
  /** @type {{width: number, height: number} | null} */
  #fullSize = null;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #turnTimer;
  /** @type {LiveView | null} */
  #live;
  #stopListening;
  #resizes;
  /** True while another viewer uses its graphics context. */
  #waitsForContext = false;
  /** True while a backend is being created. */
  #creatingBackend = false;
  /** Its entry among the viewers that share the page's WebGL2 contexts. @type {Holder} */
  #holder = {
    asleep: () => this.#asleep,
    busy: () => this.#creatingBackend,
    giveBack: () => this.#giveBack(),
    retry: () => this.#drawAgain(),
  };

  /**
   * @param {HTMLElement} root focusable element that receives the input and contains the pictures
   * @param {{atlas?: string, view?: string, report?: string, offset?: {x: number, y: number, z: number}, embedded?: () => boolean,
   *   live?: Live, settings?: object | Promise<object>, full?: Promise<{width?: number, height?: number} | undefined>}} options `atlas`,
   *   `view`, `report`: addresses of the container, the server's views and the photo's report; `offset`: start position of the camera, in
   *   units of the view box, which overrides that of the settings; `embedded`: whether the viewer is part of a page that scrolls;
   *   `settings`: the owner's settings (settings.js); `full`: the photo's full size, if the container is a smaller level; `live`: a room to
   *   watch instead of a container
   */
  constructor(root, options) {
    super(options);
    this.root = root;
    this.options = options;
    this.#adaptive = new AdaptiveResolution(Boolean(options.live));
    this.#stage = new Stage(root);
    this.#live = options.live ? new LiveView(this, { stage: this.#stage, draw: (replaces) => this.#draw(replaces) }) : null;
    this.mode = 'loading';
    /** The headset that shows the scene (input/xr.js), or null. */
    this.headset = /** @type {Headset | null} */ (null);
    this.scene = /** @type {Scene | null} */ (null);
    this.head = /** @type {SceneHead & {total: number} | null} */ (null);
    this.renderer = /** @type {WebGpuRenderer | WebGlRenderer | null} */ (null);
    this.serverViews = /** @type {ServerViews | null} */ (null);
    options.full?.then((size) => this.#setFullSize(size));
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

  /** The photo's element, below the scene's canvas. */
  get poster() {
    return this.#stage.poster;
  }

  /** The scene's canvas, or null. */
  get canvas() {
    return this.#stage.canvas;
  }

  /** True while an animation frame is requested. */
  get moving() {
    return this.#frameRequest !== 0;
  }

  /** Smoothed time of a frame in ms, or null before the first. */
  get frameMs() {
    return this.#adaptive.ms;
  }

  async prepare() {
    try {
      await this.drawMode.prepare(this.renderer);
    } catch (error) {
      this.emit('error', { message: error.message });
    }
    this.render();
  }

  /**
   * Focuses on a point of the canvas, in shares of its width and height from the upper left.
   * @param {number} x
   * @param {number} y
   */
  async focusAt(x, y) {
    const { canvas } = this;
    const view = this.#currentView;
    if (!this.renderer || !view || !canvas || this.stereo) return;
    this.drawMode.depthOfField.focus = await this.drawMode.disparityAt(this.renderer, { ...view, canvas }, x, y);
    this.render();
  }

  /** Shows the scene in a headset. Call it from a user gesture; throws if that is not allowed. */
  async enterHeadset() {
    if (this.headset || !this.scene || !this.limits) return;
    const { Headset } = await import('../input/xr.js');
    this.headset = await Headset.enter(this.scene, this.limits, () => {
      this.headset = null;
      this.asleep = false;
    });
    // the page is out of sight meanwhile
    this.asleep = true;
  }

  /** The view at the current pose as a PNG file, in the photo's size, or in the screen's if only a part is visible. */
  async picture() {
    const view = this.#currentView;
    if (!this.renderer || !view) throw new Error('a picture can be taken only if the browser draws the scene');
    const { width, height } = this.lens.size;
    const ratio = pixelRatio();
    const size = this.lens.close ? { width: Math.round(width * ratio), height: Math.round(height * ratio) } : null;
    return this.drawMode.picture(this.renderer, view, size, size ? this.#detailRenderer : undefined);
  }

  /** The view to draw, or null until the head of the scene is known. */
  get #currentView() {
    const { pose, head, pivot, moving } = this;
    return head && { pose, head, pivot, moving, frame: this.camera.framed(this.lens.frame) };
  }

  /** True while the viewer is out of sight; it then draws nothing. */
  get asleep() {
    return this.#asleep;
  }

  set asleep(on) {
    this.#asleep = on;
    if (on) {
      cancelAnimationFrame(this.#frameRequest);
      this.#frameRequest = 0;
      lendContext(this.#holder);
    } else if (this.#waitsForContext) this.#drawAgain();
    else this.wake();
  }

  /** Gives its graphics context to another viewer and shows the photo meanwhile. */
  #giveBack() {
    this.#waitsForContext = true;
    this.#backends?.givenBack();
    this.#detail?.dispose();
    this.#detail = null;
    this.renderer?.dispose();
    this.renderer = null;
    this.#stage.canvas = null;
    this.mode = 'loading';
    this.emit('mode', { mode: 'loading', reason: 'Another viewer on the page uses the graphics context.' });
  }

  /** Draws again after a time without a graphics context. */
  #drawAgain() {
    this.#waitsForContext = false;
    // the room's texels are lost with the context
    if (this.options.live) this.postToWorker({ again: true });
    else this.#draw();
  }

  moved() {
    insistOnContext(this.#holder);
    super.moved();
  }

  /** Draws now. */
  render() {
    const view = this.#currentView;
    if (!this.head || !view || this.disposed) return;
    if (this.renderer?.context && this.canvas) {
      const { depthOfField } = this.drawMode;
      const times = this.drawMode.draw(this.renderer, { ...view, canvas: this.canvas });
      this.#drawDetail({ ...view, canvas: this.canvas });
      if (depthOfField.unfinished) this.wake();
      if (!times) return;
      const { detail } = this.#adaptive;
      this.#adaptive
        .measure(this.renderer, () => this.moving || this.#playing)
        .then((ms) => {
          if (ms === null) return;
          // apply the new resolution in the next frame
          if (this.#playing && this.#adaptive.detail !== detail) this.wake();
          depthOfField.cost = ms / times;
          this.emit('frame', { ms: this.#adaptive.ms });
        });
    } else if (this.mode === 'served') this.#requestView(this.head);
  }

  /**
   * Requests the current view from the server.
   * @param {SceneHead} head
   */
  #requestView(head) {
    const ratio = pixelRatio();
    const { width, height } = this.lens.size;
    const size = { width: width * ratio, height: height * ratio };
    this.serverViews?.show(this.camera.quantisedPose, fovX(head.intrinsics, head.width), size, this.lens.frame);
  }

  /**
   * The view at the current pose, as the server would draw it.
   * @returns {Promise<Uint8ClampedArray>} premultiplied RGBA
   */
  async readPixels(width = this.head?.width ?? 0, height = this.head?.height ?? 0) {
    if (!this.renderer || !this.head) throw new Error('pixels can be read only if the browser draws the scene');
    return this.renderer.readPixels(this.pose, resized(this.head.intrinsics, this.head, { width, height }), width, height);
  }

  dispose() {
    super.dispose();
    cancelAnimationFrame(this.#frameRequest);
    clearTimeout(this.#turnTimer);
    this.#detail?.dispose();
    this.#worker?.terminate();
    this.#stopListening();
    this.headset?.end();
    this.#resizes.disconnect();
    document.removeEventListener('visibilitychange', this.#onVisible);
    this.renderer?.dispose();
    // a backend that is being created has its context until that is done
    if (!this.#creatingBackend) leaveContext(this.#holder);
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
      return this.#fail(`The page does not allow workers, which rooms require: ${error.message}`);
    }
    this.#worker.onerror = (/** @type {{message: string}} */ { message }) => this.#fail(message || 'The decoder could not be started.');
    this.#worker.onmessage = (/** @type {MessageEvent} */ { data }) => this.#onWorker(data);
    if (live) this.#worker.postMessage({ watch: { address: live.address, token: live.token, side, flat: !any } });
    else this.#worker.postMessage({ url: this.options.atlas, photoOnly: !any, side });
  }

  /** @param {any} data posted by decode/worker.js or live/worker.js */
  #onWorker(data) {
    if (data.type === 'progress') this.emit('progress', { received: data.received, total: data.total || this.head?.total || 0 });
    else if (data.type === 'head') {
      this.head = data.head;
      this.camera.setScene(data.head, null);
      this.layout();
    } else if (data.type === 'photo') {
      this.#stage.showPhoto(data.blob);
      this.emit('photo');
      if (this.#backends && !this.#backends.any) this.#serve(this.#backends.reason);
    } else if (data.type === 'scene') {
      this.scene = data.scene;
      if (this.head) this.camera.setScene(this.head, this.scene);
      if (this.#live) return this.#live.draw(data.cells);
      this.#worker?.terminate();
      this.#draw();
    } else if (data.type === 'update') this.#live?.follow(data);
    else if (data.type === 'picture') this.#live?.showFlat(data.picture, data.early);
    else if (data.type === 'error') this.#fail(data.message);
    else this.emit('live', data);
  }

  /**
   * Sends a message to a room's worker.
   * @param {object} message
   * @param {ArrayBuffer[]} transfer buffers to transfer
   */
  postToWorker(message, transfer = []) {
    this.#worker?.postMessage(message, transfer);
  }

  /**
   * Handles a container that cannot be loaded or decoded: falls back to the server's views if at least its head has arrived.
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
   * Draws on the best available backend.
   * @param {boolean} [replaces] whether another scene was drawn before
   */
  async #draw(replaces = false) {
    if (replaces) this.#backends = await Backends.find();
    if (!this.#backends || !this.scene) return;
    this.#creatingBackend = true;
    const backend = await this.#backends.next(this.scene, (reason) => this.#onLost(reason), this.#holder);
    this.#creatingBackend = false;
    if (this.disposed) {
      if (backend !== 'wait') backend?.renderer.dispose();
      leaveContext(this.#holder);
      return;
    }
    if (backend === 'wait') {
      this.#waitsForContext = true;
      return;
    }
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
    // idle motion would request views without end
    this.setIdle(false);
    if (this.options.live) return this.postToWorker({ flat: true });
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

  /** Whether a room is playing. */
  get #playing() {
    return this.#live?.playing ?? false;
  }

  /**
   * Resolution per side, as a share of the full one: 1 at rest. While a room plays, at least the resolution of its frames, or half of it in
   * motion.
   * @param {number} width in CSS pixels
   */
  #resolution(width) {
    const { detail } = this.#adaptive;
    if (!this.#playing) return this.moving ? detail : 1;
    const own = Math.min(1, (this.head?.width ?? 0) / (width * pixelRatio()));
    return Math.max(detail, this.moving ? own / 2 : own);
  }

  /** Fits the whole pictures into the root element, in the photo's aspect ratio. */
  layout() {
    if (!this.head || this.disposed) return;
    const fit = this.#stage.fit((this.head.width / this.head.height) * (this.renderer ? columnsOf(this.stereo) : 1));
    if (!fit) return;
    this.lens.measure(this.#stage.size, fit, (this.#fullSize ?? this.head).width / (fit.width * (devicePixelRatio || 1)));
    const { size, frame } = this.lens;
    this.#stage.layout(size, fit, frame, this.mode === 'served');
    if (this.canvas && this.renderer) {
      setPixels(this.canvas, size, this.#resolution(size.width), this.renderer.maxSide);
      if (!this.renderer.context) return;
    }
    this.render();
  }

  /** @param {{width?: number, height?: number} | undefined} size */
  #setFullSize(size) {
    if (!size?.width || !size.height) return;
    this.#fullSize = { width: size.width, height: size.height };
    this.layout();
  }

  /** Renderer of the finer part, if one is shown. */
  get #detailRenderer() {
    return this.drawMode.plain ? this.#detail?.shown?.renderer : undefined;
  }

  /**
   * Draws the finer part over the scene, and loads it if it is missing.
   * @param {Parameters<DrawMode['draw']>[1]} view
   */
  #drawDetail(view) {
    const { canvas, head } = this;
    const { atlas } = this.options;
    if (!canvas || !head || !atlas || !this.#fullSize || !this.#backends) return;
    if (!this.#detail && this.lens.close && (this.mode === 'gpu' || this.mode === 'webgl')) {
      const { mode } = this;
      const changed = () => this.render();
      this.#detail = new Detail({ atlas, mode, side: this.#backends.side, photo: this.#fullSize, loaded: head, changed });
    }
    if (this.drawMode.plain)
      this.#detail?.update(this.lens.frame, { width: this.lens.size.width * pixelRatio(), height: this.lens.size.height * pixelRatio() });
    const shown = this.#detailRenderer && this.#detail?.shown;
    this.#stage.detail = shown ? shown.canvas : null;
    if (!shown) return;
    const { width, height } = canvas;
    if (shown.canvas.width !== width || shown.canvas.height !== height) [shown.canvas.width, shown.canvas.height] = [width, height];
    this.drawMode.draw(shown.renderer, { ...view, canvas: shown.canvas });
  }

  wake() {
    clearTimeout(this.#turnTimer);
    if (this.#frameRequest || this.#asleep || this.disposed || this.mode === 'failed') return;
    this.#lastFrame = 0;
    this.#frameRequest = requestAnimationFrame((now) => this.#frame(now));
  }

  /** @param {number} now */
  #frame(now) {
    this.#frameRequest = 0;
    this.#live?.applyUpdate();
    const dt = this.#lastFrame ? (now - this.#lastFrame) / 1000 : 1 / 60;
    if (this.mode === 'loading') return;
    const closing = this.lens.step(dt);
    // zooming magnifies the camera's motion
    this.camera.damping = this.lens.now.scale ** -0.5;
    const moving = (!this.camera.holdsPose && this.motion.step(dt)) || closing;
    if (moving && !closing && this.motion.paused && this.#adaptive.detail < 1)
      this.#turnTimer = setTimeout(() => this.wake(), TURN_PAUSE_MS);
    else if (moving) {
      this.#lastFrame = now;
      this.#frameRequest = requestAnimationFrame((next) => this.#frame(next));
    }
    this.layout();
  }

  #onVisible = () => {
    if (!document.hidden) this.wake();
  };
}

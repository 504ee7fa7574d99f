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

import { startDecoder } from '../decode/start.js';
import { Backends } from '../draw/backends.js';
import { ServerViews } from '../draw/server-views.js';
import { CameraControl } from '../input/camera-control.js';
import { listen } from '../input/gestures.js';
import { Tilt } from '../input/gyroscope.js';
import { Motion } from '../input/motion.js';
import { Zoom } from '../input/zoom.js';
import { fovX, POSE_KEYS, resized } from './camera.js';
import { pixelRatio, setPixels } from './canvas-size.js';
import { Detail } from './detail.js';
import { Display } from './display.js';
import { FramePacing } from './frame-pacing.js';
import { Stage } from './stage.js';

/** @import { Offset, Scene, SceneHead } from '../decode/scene.js' */
/** @import { Instances } from '../draw/instances.js' */
/** @import { ServedViews } from '../live/served-views.js' */
/** @import { Cells } from '../live/tile-atlas.js' */
/** @import { WebGlRenderer } from '../draw/webgl.js' */
/** @import { WebGpuRenderer } from '../draw/webgpu.js' */
/** @import { Headset } from '../input/xr.js' */
/** @import { Pose } from './camera.js' */
/** @import { Settings } from './settings.js' */

/** How long idle motion rests at a turn where the machine is too slow to draw all pixels while it moves, ms. */
const REST_MS = 1500;

export class Viewer extends EventTarget {
  /** @type {Worker | null} */
  #worker = null;
  #frameRequest = 0;
  #lastFrame = 0;
  /** @type {Backends | null} */
  #backends = null;
  #stage;
  #display;
  #camera;
  #tilt;
  #asleep = false;
  #pacing = new FramePacing();
  #zoom = new Zoom();
  /** @type {Detail | null} */
  #detail = null;
  /** @type {{width: number, height: number} | null} */
  #full = null;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #rest;
  #disposed = false;
  /**
   * Views of a room that the server draws, where nothing here does.
   * @type {ServedViews | null}
   */
  #served = null;
  /** Nothing here decodes a room's video. */
  #undecoded = false;
  /** A room's video is shown as it is until there is a scene. */
  #early = false;
  /**
   * Frames of a room that came since the screen was refreshed.
   * @type {{instances: Instances | null, cells: Cells}[]}
   */
  #fresh = [];
  /** A room's scenes are drawn one after the other. */
  #redrawn = Promise.resolve();
  #stopListening;
  #resizes;
  #reduced = matchMedia('(prefers-reduced-motion: reduce)');

  /**
   * @param {HTMLElement} root focusable element that takes the input and holds the pictures
   * @param {{atlas?: string, view?: string, report?: string, offset?: {x: number, y: number, z: number}, embedded?: () => boolean,
   *   live?: {start: () => Worker, address: string, token: string, Views: typeof ServedViews}, settings?: object | Promise<object>, full?: Promise<{width?: number, height?: number} | undefined>}} options addresses of the container, of the views that the server draws and of the photo's
   *   report; where the camera starts, in units of the view box; whether the viewer is a part of a page that scrolls now; what the photo's
   *   owner wants (settings.js), which the camera's start given here overrules; the photo's own size, where the container is a smaller
   *   level of it; `live`: a room to watch in place of a container, what starts its worker, and
   *   what shows views that the server draws of it
   */
  constructor(root, options) {
    super();
    this.root = root;
    this.options = options;
    this.#stage = new Stage(root);
    this.#display = new Display(options.report);
    this.mode = 'loading';
    /** What shows the scene in a headset (input/xr.js) while one does, else null. */
    this.headset = /** @type {Headset | null} */ (null);
    this.scene = /** @type {Scene | null} */ (null);
    this.head = /** @type {SceneHead & {total: number} | null} */ (null);
    this.renderer = /** @type {WebGpuRenderer | WebGlRenderer | null} */ (null);
    this.serverViews = /** @type {ServerViews | null} */ (null);
    this.motion = new Motion();
    this.motion.setIdle(!this.#reduced.matches);
    this.#camera = new CameraControl(this.motion);
    this.#tilt = new Tilt(this.motion, () => this.#moved());
    if (options.offset) this.motion.jump(options.offset);
    this.#camera.touched = Boolean(options.offset);
    Promise.resolve(options.settings ?? {}).then((settings) => this.#obey(settings));
    options.full?.then((size) => this.#knowFull(size));
    this.#stopListening = listen(root, this.motion, this.#zoom, {
      wake: () => this.#moved(),
      toggleIdle: () => this.setIdle(!this.idle),
      embedded: options.embedded,
    });
    this.#resizes = new ResizeObserver(() => this.#layout());
    this.#resizes.observe(root);
    this.#reduced.addEventListener('change', this.#onReduced);
    document.addEventListener('visibilitychange', this.#onVisible);
    this.#start();
  }

  /**
   * As of every event target; the events are those named above.
   * @param {string} type
   * @param {(event: any) => void} listener to a CustomEvent
   * @param {AddEventListenerOptions | boolean} [options]
   */
  addEventListener(type, listener, options) {
    super.addEventListener(type, listener, options);
  }

  /** The picture of the photo, which lies below the scene. */
  get poster() {
    return this.#stage.poster;
  }

  /** What the scene is drawn on, or null. */
  get canvas() {
    return this.#stage.canvas;
  }

  /** True while the camera moves by itself when left alone. */
  get idle() {
    return this.motion.idle;
  }

  /** True while another frame is to come. */
  get moving() {
    return this.#frameRequest !== 0;
  }

  /** Smoothed time of a frame in ms, or null before the first. */
  get frameMs() {
    return this.#pacing.ms;
  }

  /** What the photo's owner wants of the camera (settings.js). */
  get settings() {
    return this.#camera.settings;
  }

  /** Changes it, now. */
  set settings(settings) {
    this.#camera.touched = true;
    this.#obey(settings);
  }

  /** @param {Settings} settings */
  #obey(settings) {
    if (this.#disposed) return;
    this.#camera.obey(settings);
    if (settings.idle === 'none') this.setIdle(false);
    this.render();
    this.#emit('pose');
  }

  /** What the photo itself goes of the view box where its owner does not say: shares. */
  get usual() {
    return this.#camera.usual;
  }

  /** Where the camera is in the view box. */
  get place() {
    return this.#camera.place;
  }

  /**
   * How large the photo is shown: 1 where all of it is seen, `own` where its pixels are those of the screen, `most` at the closest; `goal`
   * is what it is on its way to.
   */
  get zoom() {
    const { now, target, own, most } = this.#zoom;
    return { ...now, goal: target.scale, own, most };
  }

  /**
   * Comes closer by a factor, about a place given in CSS pixels from the middle.
   * @param {number} by
   * @param {{x: number, y: number}} [at]
   */
  zoomBy(by, at = { x: 0, y: 0 }) {
    this.#zoom.by(by, at);
    this.#moved();
  }

  /** Half extents of where the camera goes, in units of the nearest distance, or null before that is known. */
  get limits() {
    return this.#camera.limits;
  }

  /** Disparity that views turn about. */
  get pivot() {
    return this.#camera.pivot;
  }

  /** @param {boolean} on */
  setIdle(on) {
    this.motion.setIdle(on);
    this.#wake();
    this.#emit('idle', { on });
  }

  /** What is drawn over the scene, one of `OVERLAYS` (display.js); only where the browser draws. */
  get overlay() {
    return this.#display.overlay;
  }

  set overlay(name) {
    this.#display.overlay = name;
    this.#prepare();
    this.render();
  }

  async #prepare() {
    try {
      await this.#display.prepare(this.renderer);
    } catch (error) {
      this.#emit('error', { message: error.message });
    }
    this.render();
  }

  /** A view for each eye, side by side; only where the browser draws. */
  get stereo() {
    return this.#display.stereo;
  }

  set stereo(on) {
    this.#display.stereo = on;
    this.#layout();
  }

  /** How much blurs what lies away from the focus, 0 to 1; only where the browser draws. */
  get blur() {
    return this.#display.depthOfField.blur;
  }

  set blur(share) {
    this.#display.depthOfField.blur = Math.max(0, Math.min(1, share || 0));
    this.render();
  }

  /** Disparity of what is sharp. */
  get focus() {
    return this.#display.depthOfField.focus ?? this.pivot;
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
    this.#display.depthOfField.focus = await this.#display.disparityAt(this.renderer, { ...seen, canvas }, x, y);
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

  /**
   * Lets the tilt of the device move the camera, or not; to be called from a tap. Throws where that is not allowed.
   * @param {boolean} on
   */
  setTilt(on) {
    return this.#tilt.set(on);
  }

  /** True while the tilt of the device moves the camera, which it does once the browser has allowed it. */
  get tilting() {
    return this.#tilt.on;
  }

  /** The view at the present pose as a PNG file, in the photo's size; where only a part is seen, in that of the screen. */
  async picture() {
    const seen = this.#seen;
    if (!this.renderer || !seen) throw new Error('a picture can be taken only where the browser draws');
    const { width, height } = this.#zoom.size;
    const ratio = pixelRatio();
    const closer = this.#zoom.close ? { width: Math.round(width * ratio), height: Math.round(height * ratio) } : null;
    return this.#display.picture(this.renderer, seen, closer, closer ? this.#detailed : undefined);
  }

  /** What is seen now, or null before the head of the scene is known. */
  get #seen() {
    const { pose, head, pivot, moving } = this;
    return head && { pose, head, pivot, moving, frame: this.#camera.framed(this.#zoom.frame) };
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
      this.#served?.stop();
    } else this.#wake();
  }

  /** Eases back to where the photo was taken. */
  reset() {
    this.motion.home();
    this.#zoom.home();
    this.#moved();
  }

  /**
   * Puts the camera at an offset in units of the view box.
   * @param {Offset} offset
   */
  moveTo(offset) {
    this.motion.jump(offset);
    this.#moved();
  }

  /** Input came. */
  #moved() {
    this.#camera.moved();
    this.#wake();
    this.#emit('pose');
  }

  /**
   * Puts the camera at a pose exactly, and stops moving by itself; not limited to the view box.
   * @param {Partial<Pose>} pose
   */
  setPose(pose) {
    this.setIdle(false);
    this.#camera.hold(pose);
    this.render();
    this.#emit('pose');
  }

  /** The pose shown now. */
  get pose() {
    return this.#camera.pose;
  }

  /** Draws now. */
  render() {
    const seen = this.#seen;
    if (!this.head || !seen || this.#disposed) return;
    if (this.renderer?.context && this.canvas) {
      const { depthOfField } = this.#display;
      const times = this.#display.draw(this.renderer, { ...seen, canvas: this.canvas });
      this.#drawDetail({ ...seen, canvas: this.canvas });
      if (depthOfField.unfinished) this.#wake();
      if (!times) return;
      this.#pacing
        .measure(this.renderer, () => this.moving)
        .then((ms) => {
          if (ms === null) return;
          depthOfField.cost = ms / times;
          this.#emit('frame', { ms: this.#pacing.ms });
        });
    } else if (this.mode === 'served' || this.mode === 'flat') this.#ask(this.head);
  }

  /**
   * Asks the server for what is seen now; of a room not where the video shows it.
   * @param {SceneHead} head
   */
  #ask(head) {
    const { coarsePose } = this.#camera;
    const views = this.options.live ? this.#served : this.serverViews;
    if (views === this.#served && !this.#wantsServed) {
      this.#served?.stop();
      this.#turn('flat');
      return;
    }
    const ratio = pixelRatio();
    const { width, height } = this.#zoom.size;
    views?.show(coarsePose, fovX(head.intrinsics, head.width), { width: width * ratio, height: height * ratio }, this.#zoom.frame);
  }

  /** Whether somebody sees what only the server can draw of a room. */
  get #wantsServed() {
    if (this.#asleep || document.hidden) return false;
    const { coarsePose } = this.#camera;
    return this.#undecoded || this.#zoom.close || POSE_KEYS.some((key) => coarsePose[key]);
  }

  /**
   * Changes between a room's video and views that the server draws of it.
   * @param {'flat' | 'served'} mode
   */
  #turn(mode) {
    if (this.mode === mode || this.#undecoded || !this.canvas) return;
    this.mode = mode;
    this.canvas.style.visibility = mode === 'served' ? 'hidden' : '';
    this.#emit('mode', { mode, reason: '' });
    this.#layout();
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
    this.#disposed = true;
    cancelAnimationFrame(this.#frameRequest);
    clearTimeout(this.#rest);
    this.#detail?.dispose();
    this.#worker?.terminate();
    this.#stopListening();
    this.#tilt.set(false);
    this.headset?.end();
    this.#resizes.disconnect();
    this.#reduced.removeEventListener('change', this.#onReduced);
    document.removeEventListener('visibilitychange', this.#onVisible);
    this.renderer?.dispose();
    this.serverViews?.dispose();
    this.#served?.dispose();
    this.#stage.dispose();
  }

  async #start() {
    this.#backends = await Backends.find();
    if (this.#disposed) return;
    const { live } = this.options;
    this.#worker = live ? live.start() : startDecoder();
    this.#worker.onerror = (event) => this.#fail(event.message || 'The decoder could not be started.');
    this.#worker.onmessage = ({ data }) => this.#onWorker(data);
    const { any, side } = this.#backends;
    if (live) this.#worker.postMessage({ watch: { address: live.address, token: live.token, side, flat: !any } });
    else this.#worker.postMessage({ url: this.options.atlas, photoOnly: !any, side });
  }

  /** @param {any} data posted by decode/worker.js or live/worker.js */
  #onWorker(data) {
    if (this.#undecoded && (data.type === 'scene' || data.type === 'picture')) {
      // another publisher, of whose video there is a decoder
      this.#undecoded = false;
      this.#served?.dispose();
      this.#served = null;
    }
    if (data.type === 'progress') this.#emit('progress', { received: data.received, total: data.total || this.head?.total || 0 });
    else if (data.type === 'head') {
      this.head = data.head;
      this.#camera.know(data.head, null);
      this.#served?.dispose();
      this.#served = null;
      if (this.#undecoded) this.#serveAlone(data.head);
      this.#layout();
    } else if (data.type === 'photo') {
      this.#stage.showPhoto(data.blob);
      this.#emit('photo');
      if (this.#backends && !this.#backends.any) this.#serve(this.#backends.reason);
    } else if (data.type === 'scene') {
      this.scene = data.scene;
      if (this.head) this.#camera.know(this.head, this.scene);
      if (this.options.live) {
        this.#early = false;
        return this.#drawLive(data.cells);
      }
      this.#worker?.terminate();
      this.#draw();
    } else if (data.type === 'update') this.#follow(data);
    else if (data.type === 'picture') this.#showFlat(data.picture, data.early);
    else if (data.type === 'error') this.#fail(data.message);
    else if (data.state === 'unsupported' && this.head) this.#serveAlone(this.head);
    else this.#emit('live', data);
  }

  /**
   * Has the server draw a room all the time: nothing here decodes its video.
   * @param {SceneHead} head
   */
  #serveAlone(head) {
    if (this.#undecoded && this.#served) return;
    this.#undecoded = true;
    this.renderer?.dispose();
    this.renderer = null;
    this.#stage.canvas = null;
    this.mode = 'served';
    this.setIdle(false);
    let [shown, said] = [false, ''];
    const say = (/** @type {string} */ state) => {
      if (state !== said) this.#emit('live', { type: 'state', state, reason: '' });
      said = state;
    };
    this.#prepareServed(head, {
      shown: (fresh) => {
        if (!shown) this.#emit('ready', { mode: 'served' });
        shown = true;
        say(fresh ? 'live' : 'stalled');
      },
      refused: (state) => say(state === 'busy' ? 'stalled' : state === 'waiting' && shown ? 'ended' : state),
    });
    this.#layout();
  }

  /**
   * @param {SceneHead} head
   * @param {{shown: (fresh: boolean) => void, refused: (state: string) => void}} on
   */
  #prepareServed(head, on) {
    const { live } = this.options;
    if (live) this.#served = new live.Views(this.poster, live, head, on);
  }

  /**
   * Says something to a room's worker.
   * @param {object} message
   */
  tell(message) {
    this.#worker?.postMessage(message);
  }

  /**
   * Draws a room's scene from its beginning.
   * @param {Cells} cells
   */
  #drawLive(cells) {
    const { scene } = this;
    // one after the other, and only the newest
    this.#redrawn = this.#redrawn.then(async () => {
      if (this.#disposed || scene !== this.scene) return;
      // what was drawn before was another scene
      if (this.renderer) this.#backends = await Backends.find();
      const before = this.renderer;
      await this.#draw();
      before?.dispose();
      if (this.renderer) this.#follow({ instances: null, cells });
    });
  }

  /**
   * Shows the next frame of a room when the screen is refreshed; a page that nobody sees asks for no more.
   * @param {{instances: Instances | null, cells: Cells}} change
   */
  #follow(change) {
    if (this.#disposed) return;
    this.#fresh.push(change);
    requestAnimationFrame(() => {
      // while the camera moves, it is drawn with the camera's next step: once for each refresh
      if (this.#frameRequest || !this.#takeFresh()) return;
      this.render();
    });
  }

  /** Hands frames of a room to what draws them; false where there are none. */
  #takeFresh() {
    const fresh = this.#fresh.splice(0);
    if (!fresh.length || this.#disposed || !this.renderer) return false;
    for (const change of fresh) this.renderer.update(change);
    this.tell({ drawn: true });
    return true;
  }

  /**
   * Shows a frame of a room as it is, where nothing can draw its scene, or there is none yet.
   * @param {VideoFrame | ImageBitmap} picture
   * @param {boolean} early there is none yet
   */
  #showFlat(picture, early) {
    const { head } = this;
    if (!head || this.#disposed) return picture.close();
    if (early) return this.#showEarly(picture, head);
    // the video is there again where the server refuses
    if (!this.#served) {
      this.#prepareServed(head, { shown: () => this.#turn('served'), refused: () => this.#turn('flat') });
      this.render();
    }
    if (!this.canvas) {
      const canvas = document.createElement('canvas');
      [canvas.width, canvas.height] = [head.width, head.height];
      this.#stage.canvas = canvas;
      this.mode = 'flat';
      this.setIdle(false);
      this.#layout();
      this.#emit('ready', { mode: 'flat' });
    }
    requestAnimationFrame(() => {
      this.canvas?.getContext('2d')?.drawImage(picture, 0, 0, head.width, head.height);
      picture.close();
      this.tell({ drawn: true });
    });
  }

  /**
   * Shows a frame of a room of which nothing is known but that.
   * @param {VideoFrame | ImageBitmap} picture
   * @param {SceneHead} head
   */
  #showEarly(picture, head) {
    if (!this.#early || !this.canvas) {
      this.#early = true;
      // of the room as it was before
      this.renderer?.dispose();
      this.renderer = null;
      const canvas = document.createElement('canvas');
      [canvas.width, canvas.height] = [head.width, head.height];
      this.#stage.canvas = canvas;
      this.mode = 'flat';
      this.#layout();
      this.#emit('ready', { mode: 'flat', early: true });
    }
    const { canvas } = this;
    requestAnimationFrame(() => {
      if (this.#early) canvas?.getContext('2d')?.drawImage(picture, 0, 0, head.width, head.height);
      picture.close();
      this.tell({ drawn: true });
    });
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
      this.#emit('error', { message });
    }
  }

  /** Draws on the best backend that can be had. */
  async #draw() {
    if (!this.#backends || !this.scene) return;
    const backend = await this.#backends.next(this.scene, (reason) => this.#onLost(reason));
    if (this.#disposed) return backend?.renderer.dispose();
    if (!backend) return this.#serve(this.#backends.reason);
    this.#detail?.dispose();
    this.#detail = null;
    this.#stage.canvas = backend.canvas;
    this.renderer = backend.renderer;
    this.mode = backend.mode;
    this.#layout();
    this.renderer.attach(backend.canvas);
    this.#prepare();
    this.render();
    this.#wake();
    this.#emit('ready', { mode: this.mode });
  }

  /** @param {string} reason */
  #onLost(reason) {
    if (this.#disposed) return;
    this.renderer = null;
    this.mode = 'loading';
    this.#emit('mode', { mode: 'loading', reason });
    // what a room showed is gone with the device
    if (this.options.live) this.tell({ again: true });
    else this.#draw();
  }

  /** @param {string} reason */
  #serve(reason) {
    if (this.#disposed) return;
    this.#stage.canvas = null;
    // a swing would ask the server without end
    this.setIdle(false);
    if (this.options.live) return this.tell({ flat: true });
    if (!this.options.view || !this.head) {
      this.mode = 'still';
      this.#emit('mode', { mode: 'still', reason });
      this.#emit('ready', { mode: 'still' });
      return;
    }
    this.serverViews = new ServerViews(this.poster, this.options.view, this.head, (error) =>
      this.#emit('error', { message: error.message }),
    );
    this.mode = 'served';
    this.#emit('mode', { mode: 'served', reason });
    this.#layout();
    this.render();
    this.#emit('ready', { mode: 'served' });
  }

  /** Fits the pictures into the root, whole, in the photo's own shape. */
  #layout() {
    if (!this.head || this.#disposed) return;
    const fit = this.#stage.fit((this.head.width / this.head.height) * (this.stereo && this.renderer ? 2 : 1));
    if (!fit) return;
    this.#zoom.measure(this.#stage.room, fit, (this.#full ?? this.head).width / (fit.width * (devicePixelRatio || 1)));
    const { size, frame } = this.#zoom;
    this.#stage.lay(size, fit, frame, this.mode === 'served');
    if (this.canvas && this.renderer) {
      setPixels(this.canvas, size, this.moving ? this.#pacing.detail : 1, this.renderer.maxSide);
      if (!this.renderer.context) return;
    }
    this.render();
  }

  /** @param {{width?: number, height?: number} | undefined} size */
  #knowFull(size) {
    if (!size?.width || !size.height) return;
    this.#full = { width: size.width, height: size.height };
    this.#layout();
  }

  /** What draws a finer part of what is in sight, where one does. */
  get #detailed() {
    return this.#display.plain ? this.#detail?.shown?.renderer : undefined;
  }

  /**
   * Draws finer parts over the scene, and sees to those that are missing.
   * @param {Parameters<Display['draw']>[1]} seen
   */
  #drawDetail(seen) {
    const { canvas, head } = this;
    const { atlas } = this.options;
    if (!canvas || !head || !atlas || !this.#full || !this.#backends) return;
    if (!this.#detail && this.#zoom.close && (this.mode === 'gpu' || this.mode === 'webgl')) {
      const { mode } = this;
      const changed = () => this.render();
      this.#detail = new Detail({ atlas, mode, side: this.#backends.side, photo: this.#full, loaded: head, changed });
    }
    if (this.#display.plain)
      this.#detail?.look(this.#zoom.frame, { width: this.#zoom.size.width * pixelRatio(), height: this.#zoom.size.height * pixelRatio() });
    const shown = this.#detailed && this.#detail?.shown;
    this.#stage.detail = shown ? shown.canvas : null;
    if (!shown) return;
    const { width, height } = canvas;
    if (shown.canvas.width !== width || shown.canvas.height !== height) [shown.canvas.width, shown.canvas.height] = [width, height];
    this.#display.draw(shown.renderer, { ...seen, canvas: shown.canvas });
  }

  #wake() {
    clearTimeout(this.#rest);
    if (this.#frameRequest || this.#asleep || this.#disposed || this.mode === 'failed') return;
    this.#lastFrame = 0;
    this.#frameRequest = requestAnimationFrame((now) => this.#frame(now));
  }

  /** @param {number} now */
  #frame(now) {
    this.#frameRequest = 0;
    this.#takeFresh();
    const dt = this.#lastFrame ? (now - this.#lastFrame) / 1000 : 1 / 60;
    if (this.mode === 'loading') return;
    const closing = this.#zoom.step(dt);
    // what is shown larger moves as much farther
    this.#camera.damping = this.#zoom.now.scale ** -0.5;
    const moving = (!this.#camera.held && this.motion.step(dt)) || closing;
    if (moving && !closing && this.motion.paused && this.#pacing.detail < 1) this.#rest = setTimeout(() => this.#wake(), REST_MS);
    else if (moving) {
      this.#lastFrame = now;
      this.#frameRequest = requestAnimationFrame((next) => this.#frame(next));
    }
    this.#layout();
  }

  #onReduced = () => {
    if (this.#reduced.matches) this.setIdle(false);
  };

  #onVisible = () => {
    if (!document.hidden) this.#wake();
    else this.#served?.stop();
  };

  /**
   * @param {string} type
   * @param {object} [detail]
   */
  #emit(type, detail = {}) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }
}

// <tmpi-viewer src="https://host/v1/photos/ID/atlas" alt="…" poster="…"></tmpi-viewer>: a 3D photo on any page.
// <tmpi-viewer src="https://host/live/ROOM#token=…" alt="…"></tmpi-viewer>: a room, in which it moves.
//
//   src              address of a container; where it ends in /atlas, the server's views beside it serve browsers without a GPU
//   view             address of these views, where it is another
//   alt              what the photo shows
//   poster           picture until the photo is there
//   fit              `contain` (as if it were not there): all of the photo; `cover`: as large as fills the element, the rest cut away
//   fullscreen       `off`: no button for full screen
//   loading          `lazy` (as if it were not there): fetched when it comes near the screen; `eager`: at once
//   reveal           `auto` (as if it were not there), or `interaction`: fetched when somebody points at it, touches or focuses it
//   camera-controls  `off` or `false`: takes no input
//   auto-rotate      `off` or `false`: does not move by itself; so does `still`, without a value
//   motion           how it moves by itself: `swing`, `orbit`, `dolly`, `dolly-zoom`, `zoom` (into the nearest thing), or `none`; without
//                    it, what the photo's owner wants, else `swing`; rooms move by themselves only where this or auto-rotate says so
//   speed            how fast, 0.25 to 4 times the usual
//   settings         `off`: does not ask the server what the photo's owner wants of the camera (how far it goes, where it starts)
//
// Of a room, whose address (of its page, or below /v1/) stands in `src`, besides:
//
//   room             its name in place of its address; `src` is the server's own address then, this page's without it
//   token            token of who watches, where the address has none behind its # or as a parameter
//   sound            `off`: no button for it; without a value it begins with the first tap or key. It never begins before one
//
// Names, properties (`loaded`), methods (`toBlob`, `resetView`) and events are those of <model-viewer> where there are such. One
// thing differs: `camera-controls` and `auto-rotate` are on as if they were there, because a 3D photo that stands still is a photo.
//
// A room has the properties `state` and `sound`, and `setSound(on)`, which has to be called from a tap, and rejects where the browser does
// not allow it. While nobody sees the element, nothing is fetched for it, unless somebody listens; a broken connection comes back by itself.
//
// Slots: `poster` takes a picture of the page's own in place of `poster` (`<img slot="poster" …>`, which browsers show without a script,
// too), `error` what is to be seen where the photo cannot be shown; else that is `alt` and the reason. Parts for CSS: `fullscreen`, `error`; of
// rooms also `sound` and `note`, which says why there is no picture yet.
//
// Fires `progress` {received, total, totalProgress}, `load` {mode}, `camera-change` {pose} and `error` {message}; of rooms, which have no
// progress, also `state` {state, reason}, `statistics` {behind, frames, kbits, viewers, …} twice a second, and `sound` {on}. A state is
// `connecting`, `waiting` (nobody is live), `full` (no place), `live`, `stalled`, `ended`, `away` (no server), `refused` (no token), `none` (no such room) or
// `unsupported` (no decoder for its video). It is as wide as its
// place and has the photo's shape once that is known (16 / 10 before), unless CSS says `aspect-ratio` or `height`. All elements of a page
// share one graphics device; those out of sight sleep.

/** @import { Viewer } from '../view/viewer.js' */
/** @import { Room } from './room.js' */

const STYLE = `
  :host { display: block; position: relative; overflow: hidden; aspect-ratio: var(--tmpi-shape, 16 / 10); }
  :host([hidden]), [hidden] { display: none !important; }
  :host(:fullscreen) { background: #000; }
  .room { position: absolute; inset: 0; container-type: size; overflow: hidden; }
  .stage { position: absolute; inset: 0; cursor: grab; touch-action: pan-y; user-select: none; }
  .stage:active { cursor: grabbing; }
  .stage:focus-visible { outline: 3px solid Highlight; outline-offset: -3px; }
  .stage :is(img, canvas) { position: absolute; inset: 0; margin: auto; pointer-events: none; }
  img:not([src]) { visibility: hidden; }
  .poster, ::slotted([slot='poster']) { position: absolute; inset: 0; width: 100%; height: 100%; object-fit: contain; }
  :host([fit='cover']) .poster, :host([fit='cover']) ::slotted([slot='poster']) { object-fit: cover; }
  :host([fit='cover']) .stage {
    inset: auto; left: 50%; top: 50%; translate: -50% -50%;
    width: max(100cqw, 100cqh * (var(--tmpi-shape, 16 / 10))); height: max(100cqh, 100cqw / (var(--tmpi-shape, 16 / 10)));
  }
  :host([fit='cover']) .stage:focus-visible { outline: 0; }
  :host([fit='cover']) .room:has(.stage:focus-visible) { outline: 3px solid Highlight; outline-offset: -3px; }
  button {
    position: absolute; right: 8px; bottom: 8px; width: 40px; height: 40px; padding: 8px; border: 0; border-radius: 8px;
    background: rgb(0 0 0 / 55%); color: #fff; cursor: pointer; opacity: 0; transition: opacity 0.2s;
  }
  :host(:hover) button, button:focus-visible { opacity: 1; }
  @media (hover: none) { button { opacity: 0.75; } }
  button svg { display: block; width: 100%; height: 100%; fill: none; stroke: currentColor; stroke-width: 2; }
  .error {
    position: absolute; inset: 0; display: grid; place-content: center; gap: 4px; padding: 16px; box-sizing: border-box; overflow: auto;
    background: #ececea; color: #333; font: 15px/1.45 system-ui, sans-serif; text-align: center;
  }
  .error p { margin: 0; }
  .error .reason { color: #5c5c5c; font-size: 0.9em; }
`;
const CORNERS = 'M3 9V3h6M15 3h6v6M21 15v6h-6M9 21H3v-6';
/** All that the viewer is made of: fetched at once, not as each names the next. */
const MODULES = [
  'decode/grid.js',
  'decode/problem.js',
  'decode/start.js',
  'draw/backends.js',
  'draw/depth-of-field/aperture.js',
  'draw/depth-of-field/mean-webgl.js',
  'draw/depth-of-field/mean-webgpu.js',
  'draw/device.js',
  'draw/glsl.js',
  'draw/instances.js',
  'draw/server-views.js',
  'draw/texture-atlas.js',
  'draw/tile-errors.js',
  'draw/view-uniform.js',
  'draw/webgl-copy.js',
  'draw/webgl-program.js',
  'draw/webgl-target.js',
  'draw/webgl.js',
  'draw/webgpu-copy.js',
  'draw/webgpu.js',
  'element/photo-addresses.js',
  'input/camera-control.js',
  'input/gestures.js',
  'input/gyroscope.js',
  'input/motion.js',
  'input/zoom.js',
  'view/camera.js',
  'view/canvas-size.js',
  'view/detail.js',
  'view/display.js',
  'view/frame-pacing.js',
  'view/limits.js',
  'view/outlook.js',
  'view/settings.js',
  'view/stage.js',
  'view/viewer.js',
];
/** What rooms need besides. */
const ROOM_MODULES = [
  'element/room.js',
  'i18n/messages.js',
  'live/connection.js',
  'live/room-address.js',
  'live/served-views.js',
  'live/sound-player.js',
  'live/start.js',
  'live/states.js',
];
/** Path of a room, or of its page. */
const ROOM = /\/live\/[\w-]+\/?$/;
const OFF = new Set(['off', 'false']);

/** @type {Set<string>} */
const preloaded = new Set();

/**
 * Asks for modules, once a page.
 * @param {string[]} modules
 */
function preload(modules) {
  for (const name of modules.filter((name) => !preloaded.has(name))) {
    preloaded.add(name);
    const link = document.createElement('link');
    link.rel = 'modulepreload';
    link.href = new URL(`./static/${name}`, import.meta.url).href;
    document.head.append(link);
  }
}

/**
 * A module below static/.
 * @param {string} name
 */
const load = (name) => import(new URL(`./static/${name}`, import.meta.url).href);

class TmpiViewer extends HTMLElement {
  static observedAttributes = [
    'src',
    'room',
    'token',
    'view',
    'alt',
    'poster',
    'fullscreen',
    'loading',
    'reveal',
    'camera-controls',
    'auto-rotate',
    'still',
    'motion',
    'speed',
  ];
  /** @type {Viewer | null} */
  #viewer = null;
  /**
   * What is shown, where that is a room.
   * @type {Room | null}
   */
  #room = null;
  /** @type {IntersectionObserver | null} */
  #seen = null;
  #visible = true;
  #loaded = false;
  #sheet;
  #stage;
  #poster;
  #posterSlot;
  #error;
  #full;

  constructor() {
    super();
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(STYLE);
    this.#sheet = new CSSStyleSheet();
    const shadow = this.attachShadow({ mode: 'open' });
    shadow.adoptedStyleSheets = [sheet, this.#sheet];
    this.#poster = make('img', 'poster');
    this.#poster.alt = '';
    this.#poster.loading = 'lazy';
    this.#posterSlot = make('slot', '', this.#poster);
    this.#posterSlot.name = 'poster';
    // whichever picture there is tells the photo's shape before the photo comes
    this.#posterSlot.addEventListener('load', ({ target }) => this.#shapeOf(target), true);
    this.addEventListener('load', ({ target }) => this.#shapeOf(target), true);
    this.#error = errorBox();
    this.#full = fullscreenButton(() => this.#toggleFullscreen());
    this.#stage = make('div', 'stage');
    this.#stage.tabIndex = 0;
    this.#stage.setAttribute('role', 'application');
    for (const type of ['pointerenter', 'pointerdown', 'focus']) this.#stage.addEventListener(type, () => this.#start());
    shadow.append(make('div', 'room', this.#posterSlot, this.#stage), this.#error, this.#full);
  }

  /**
   * Takes over the shape of a picture of the photo.
   * @param {EventTarget | null} picture
   */
  #shapeOf(picture) {
    if (picture instanceof HTMLImageElement && !this.#viewer?.head) this.#shape(picture.naturalWidth, picture.naturalHeight);
  }

  /**
   * The element's shape where CSS does not say another.
   * @param {number} width
   * @param {number} height
   */
  #shape(width, height) {
    if (width > 0 && height > 0) this.#sheet.replaceSync(`:host { --tmpi-shape: ${width} / ${height}; }`);
  }

  async #toggleFullscreen() {
    try {
      if (document.fullscreenElement === this) await document.exitFullscreen();
      else await this.requestFullscreen();
    } catch {
      // the page, or the frame that it is in, does not allow it
      this.#full.hidden = true;
    }
  }

  /**
   * Says what the photo shows where it cannot be shown, and why.
   * @param {string} reason
   */
  #fail(reason) {
    const [alt, why] = this.#error.querySelectorAll('p');
    alt.textContent = this.getAttribute('alt');
    alt.hidden = !alt.textContent;
    why.textContent = reason;
    this.#error.hidden = false;
  }

  /** The viewer, once it has started; else null. */
  get viewer() {
    return this.#viewer;
  }

  /** True once the scene is shown. */
  get loaded() {
    return this.#loaded;
  }

  /** How a room stands, or empty where none is shown. */
  get state() {
    return this.#room?.state ?? '';
  }

  /** True while a room's sound is played. */
  get sound() {
    return this.#room?.sound ?? false;
  }

  /**
   * Plays a room's sound, or does not; on only from a tap.
   * @param {boolean} on
   */
  async setSound(on) {
    if (!this.#room) throw new Error('no room is shown');
    await this.#room.setSound(on);
  }

  /** The view at the present pose as a PNG file, in the photo's size. */
  async toBlob() {
    if (!this.#viewer) throw new Error('nothing is shown yet');
    return this.#viewer.picture();
  }

  /** Eases back to where the photo was taken. */
  resetView() {
    this.#viewer?.reset();
  }

  connectedCallback() {
    this.#describe();
    // one that the page brought along may be there already
    this.#shapeOf(this.querySelector('[slot=poster]'));
    this.#seen = new IntersectionObserver((entries) => this.#onSeen(entries[entries.length - 1].isIntersecting), { rootMargin: '200px' });
    this.#seen.observe(this);
    this.#maybeStart(false);
  }

  disconnectedCallback() {
    this.#seen?.disconnect();
    this.#stop();
  }

  /** @param {string} name */
  attributeChangedCallback(name) {
    if (!this.isConnected) return;
    this.#describe();
    if (name === 'still' || name === 'auto-rotate') this.#viewer?.setIdle(this.#movesByItself);
    if ((name === 'motion' || name === 'speed') && this.#viewer) this.#viewer.settings = { ...this.#viewer.settings, ...this.#wander };
    if (['src', 'room', 'token', 'view'].includes(name) && this.#viewer) {
      this.#stop();
      this.#start();
    }
  }

  /** Address of what is to be shown, and whether that is a room; null where nothing is named. */
  get #named() {
    const [src, room] = [this.getAttribute('src'), this.getAttribute('room')];
    if (!(src || room) || !URL.canParse(src ?? '/', document.baseURI)) return null;
    const url = new URL(src ?? '/', document.baseURI);
    if (room) url.pathname = `/live/${encodeURIComponent(room)}`;
    return { room: ROOM.test(url.pathname), address: url.href };
  }

  get #movesByItself() {
    // what is live moves without it
    if (this.#room && !this.hasAttribute('auto-rotate') && !this.hasAttribute('motion')) return false;
    const off = this.hasAttribute('still') || this.getAttribute('motion') === 'none' || OFF.has(this.getAttribute('auto-rotate') ?? '');
    return !off && !matchMedia('(prefers-reduced-motion: reduce)').matches;
  }

  /** What the page says of moving by itself: settings (view/settings.js). */
  get #wander() {
    const [idle, speed] = [this.getAttribute('motion'), Number(this.getAttribute('speed'))];
    return { ...(idle ? { idle } : {}), ...(speed > 0 ? { speed } : {}) };
  }

  /** @param {boolean} visible */
  #onSeen(visible) {
    this.#visible = visible;
    if (this.#room) this.#room.visible = visible;
    if (this.#viewer) this.#viewer.asleep = !visible;
    else this.#maybeStart(visible);
  }

  /**
   * Nothing is fetched for what nobody scrolls to or asks for, unless the page wants it.
   * @param {boolean} visible
   */
  #maybeStart(visible) {
    if (this.getAttribute('reveal') === 'interaction') return;
    if (visible || this.getAttribute('loading') === 'eager') this.#start();
  }

  #describe() {
    const kind = this.#named?.room ? '3D video' : '3D photo';
    this.#stage.setAttribute('aria-label', this.getAttribute('alt') ?? kind);
    this.#stage.setAttribute('aria-roledescription', kind);
    // the stage takes the input; without it the page scrolls and clicks as if a picture were there
    this.#stage.inert = OFF.has(this.getAttribute('camera-controls') ?? '');
    this.#full.hidden = !document.fullscreenEnabled || OFF.has(this.getAttribute('fullscreen') ?? '');
    const poster = this.getAttribute('poster');
    if (poster) this.#poster.src = poster;
    else this.#poster.removeAttribute('src');
  }

  async #start() {
    const named = this.#named;
    if (!named || this.#viewer) return;
    const viewer = await (named.room ? this.#watch(named.address) : this.#show(named.address));
    if (!viewer) return;
    if (!this.#movesByItself) viewer.setIdle(false);
    const known = () => viewer.head && this.#shape(viewer.head.width, viewer.head.height);
    let mode = '';
    viewer.addEventListener('photo', () => {
      known();
      this.#posterSlot.hidden = true;
    });
    viewer.addEventListener('progress', ({ detail }) =>
      this.#fire('progress', { ...detail, totalProgress: detail.total ? detail.received / detail.total : 0 }),
    );
    viewer.addEventListener('ready', ({ detail }) => {
      // a room's picture begins anew where its scene needs more room, which nobody need know
      if (this.#room && mode === detail.mode) return;
      mode = detail.mode;
      this.#loaded = true;
      known();
      this.#posterSlot.hidden = true;
      this.#fire('load', detail);
    });
    viewer.addEventListener('pose', () => this.#loaded && this.#fire('camera-change', { pose: viewer.pose }));
    viewer.addEventListener('error', ({ detail }) => {
      // what cannot be had while the photo is shown needs no words over it
      if (viewer.mode === 'failed') this.#fail(detail.message);
      this.#fire('error', detail);
    });
  }

  /**
   * @param {string} type
   * @param {object} detail
   */
  #fire(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  /**
   * True where that is still to be shown, and nothing is.
   * @param {string} address
   */
  #wants(address) {
    return !this.#viewer && this.isConnected && this.#named?.address === address;
  }

  /**
   * What shows a photo from now on; null where another is wanted by now.
   * @param {string} atlas
   */
  async #show(atlas) {
    preload(MODULES);
    const [{ Viewer }, { beside, fetchSettings }] = await Promise.all([
      /** @type {Promise<typeof import('../view/viewer.js')>} */ (load('view/viewer.js')),
      /** @type {Promise<typeof import('./photo-addresses.js')>} */ (load('element/photo-addresses.js')),
    ]);
    if (!this.#wants(atlas)) return null;
    const given = this.getAttribute('view');
    const state = this.getAttribute('settings') === 'off' ? undefined : beside(atlas, '/settings');
    this.#viewer = new Viewer(this.#stage, {
      atlas,
      view: given ? new URL(given, document.baseURI).href : beside(atlas, '/view'),
      report: beside(atlas, '/report'),
      settings: Promise.resolve(state ? fetchSettings(state) : {}).then((settings) => ({ ...settings, ...this.#wander })),
      embedded: true,
    });
    return this.#viewer;
  }

  /**
   * What shows a room from now on; null where another is wanted by now.
   * @param {string} address
   */
  async #watch(address) {
    preload([...MODULES, ...ROOM_MODULES]);
    const { Room } = /** @type {typeof import('./room.js')} */ (await load('element/room.js'));
    if (!this.#wants(address)) return null;
    const attribute = (/** @type {string} */ name) => this.getAttribute(name);
    const named = { address, token: attribute('token'), sound: attribute('sound'), settings: this.#wander };
    const room = new Room(this.#stage, /** @type {ShadowRoot} */ (this.shadowRoot), named, {
      fire: (type, detail) => this.#fire(type, detail),
      fail: (message) => this.#fail(message),
    });
    [this.#room, this.#viewer] = [room, room.viewer];
    room.visible = this.#visible;
    return room.viewer;
  }

  #stop() {
    if (this.#room) this.#room.dispose();
    else this.#viewer?.dispose();
    this.#room = this.#viewer = null;
    this.#loaded = false;
    this.#posterSlot.hidden = false;
    this.#error.hidden = true;
  }
}

/**
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {string} className
 * @param {Node[]} content
 */
function make(tag, className, ...content) {
  const out = document.createElement(tag);
  out.className = className;
  out.append(...content);
  return out;
}

/** What is seen where the photo cannot be shown: the page's own, or what the photo shows and why it does not. */
function errorBox() {
  const slot = make('slot', '', make('p', ''), make('p', 'reason'));
  slot.name = 'error';
  const box = make('div', 'error', slot);
  box.part.add('error');
  box.setAttribute('role', 'alert');
  box.hidden = true;
  return box;
}

/** @param {() => void} onClick */
function fullscreenButton(onClick) {
  const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  const path = document.createElementNS('http://www.w3.org/2000/svg', 'path');
  path.setAttribute('d', CORNERS);
  svg.setAttribute('viewBox', '0 0 24 24');
  svg.setAttribute('aria-hidden', 'true');
  svg.append(path);
  const button = make('button', '', svg);
  button.type = 'button';
  button.part.add('fullscreen');
  button.setAttribute('aria-label', 'Full screen');
  button.addEventListener('click', onClick);
  return button;
}

if (!customElements.get('tmpi-viewer')) customElements.define('tmpi-viewer', TmpiViewer);

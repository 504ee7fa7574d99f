// <tmpi-viewer src="https://host/v1/photos/ID/atlas" alt="…" poster="…"></tmpi-viewer>: a 3D photo on any page.
//
//   src              address of a container; where it ends in /atlas, the server's views beside it serve browsers without a GPU
//   view             address of these views, where it is another
//   alt              what the photo shows
//   poster           picture until the photo is there
//   loading          `lazy` (as if it were not there): fetched when it comes near the screen; `eager`: at once
//   reveal           `auto` (as if it were not there), or `interaction`: fetched when somebody points at it, touches or focuses it
//   camera-controls  `off` or `false`: takes no input
//   auto-rotate      `off` or `false`: does not move by itself; so does `still`, without a value
//   motion           how it moves by itself: `swing`, `orbit`, `dolly`, `dolly-zoom`, `zoom` (into the nearest thing), or `none`; without
//                    it, what the photo's owner wants, else `swing`
//   speed            how fast, 0.25 to 4 times the usual
//   settings         `off`: does not ask the server what the photo's owner wants of the camera (how far it goes, where it starts)
//
// Names, properties (`loaded`), methods (`toBlob`, `resetView`) and events are those of <model-viewer> where there are such. One
// thing differs: `camera-controls` and `auto-rotate` are on as if they were there, because a 3D photo that stands still is a photo.
//
// Fires `progress` {received, total, totalProgress}, `load` {mode}, `camera-change` {pose} and `error` {message}. It is as wide as its
// place and keeps the shape given by CSS (16 / 10 if none). All elements of a page share one graphics device; those out of sight sleep.

/** @import { Viewer } from '../view/viewer.js' */

const STYLE = `
  :host { display: block; position: relative; overflow: hidden; aspect-ratio: 16 / 10; }
  :host([hidden]) { display: none; }
  .stage { position: absolute; inset: 0; cursor: grab; touch-action: pan-y; user-select: none; }
  .stage:active { cursor: grabbing; }
  .stage:focus-visible { outline: 3px solid Highlight; outline-offset: -3px; }
  img, canvas { position: absolute; inset: 0; margin: auto; pointer-events: none; }
  img:not([src]) { visibility: hidden; }
  .poster { width: 100%; height: 100%; object-fit: contain; }
`;
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
const OFF = new Set(['off', 'false']);

let preloaded = false;

/** Asks for the modules, once a page. */
function preload() {
  if (preloaded) return;
  preloaded = true;
  for (const name of MODULES) {
    const link = document.createElement('link');
    link.rel = 'modulepreload';
    link.href = new URL(`./static/${name}`, import.meta.url).href;
    document.head.append(link);
  }
}

class TmpiViewer extends HTMLElement {
  static observedAttributes = [
    'src',
    'view',
    'alt',
    'poster',
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
  /** @type {IntersectionObserver | null} */
  #seen = null;
  #loaded = false;
  #stage;
  #poster;

  constructor() {
    super();
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(STYLE);
    const shadow = this.attachShadow({ mode: 'open' });
    shadow.adoptedStyleSheets = [sheet];
    this.#poster = document.createElement('img');
    this.#poster.className = 'poster';
    this.#poster.alt = '';
    this.#stage = document.createElement('div');
    this.#stage.className = 'stage';
    this.#stage.tabIndex = 0;
    this.#stage.setAttribute('role', 'application');
    this.#stage.setAttribute('aria-roledescription', '3D photo');
    for (const type of ['pointerenter', 'pointerdown', 'focus']) this.#stage.addEventListener(type, () => this.#start());
    shadow.append(this.#poster, this.#stage);
  }

  /** The viewer, once it has started; else null. */
  get viewer() {
    return this.#viewer;
  }

  /** True once the scene is shown. */
  get loaded() {
    return this.#loaded;
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
    if ((name === 'src' || name === 'view') && this.#viewer) {
      this.#stop();
      this.#start();
    }
  }

  get #movesByItself() {
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
    this.#stage.setAttribute('aria-label', this.getAttribute('alt') ?? '3D photo');
    // the stage takes the input; without it the page scrolls and clicks as if a picture were there
    this.#stage.inert = OFF.has(this.getAttribute('camera-controls') ?? '');
    const poster = this.getAttribute('poster');
    if (poster) this.#poster.src = poster;
    else this.#poster.removeAttribute('src');
  }

  async #start() {
    const src = this.getAttribute('src');
    if (!src || this.#viewer) return;
    preload();
    const [{ Viewer }, { beside, fetchSettings }] = await Promise.all([
      /** @type {Promise<typeof import('../view/viewer.js')>} */ (import(new URL('./static/view/viewer.js', import.meta.url).href)),
      /** @type {Promise<typeof import('./photo-addresses.js')>} */ (
        import(new URL('./static/element/photo-addresses.js', import.meta.url).href)
      ),
    ]);
    if (this.#viewer || !this.isConnected || this.getAttribute('src') !== src) return;
    const atlas = new URL(src, document.baseURI).href;
    const given = this.getAttribute('view');
    const state = this.getAttribute('settings') === 'off' ? undefined : beside(atlas, '/settings');
    const viewer = new Viewer(this.#stage, {
      atlas,
      view: given ? new URL(given, document.baseURI).href : beside(atlas, '/view'),
      report: beside(atlas, '/report'),
      settings: Promise.resolve(state ? fetchSettings(state) : {}).then((settings) => ({ ...settings, ...this.#wander })),
      embedded: true,
    });
    this.#viewer = viewer;
    if (!this.#movesByItself) viewer.setIdle(false);
    const fire = (/** @type {string} */ type, /** @type {object} */ detail) => this.dispatchEvent(new CustomEvent(type, { detail }));
    viewer.addEventListener('photo', () => (this.#poster.hidden = true));
    viewer.addEventListener('progress', ({ detail }) =>
      fire('progress', { ...detail, totalProgress: detail.total ? detail.received / detail.total : 0 }),
    );
    viewer.addEventListener('ready', ({ detail }) => {
      this.#loaded = true;
      fire('load', detail);
    });
    viewer.addEventListener('pose', () => fire('camera-change', { pose: viewer.pose }));
    viewer.addEventListener('error', ({ detail }) => fire('error', detail));
  }

  #stop() {
    this.#viewer?.dispose();
    this.#viewer = null;
    this.#loaded = false;
    this.#poster.hidden = false;
  }
}

if (!customElements.get('tmpi-viewer')) customElements.define('tmpi-viewer', TmpiViewer);

// <tmpi-viewer src="https://host/v1/photos/ID/atlas" alt="…" poster="…"></tmpi-viewer>: a 3D photo on any page.
// <tmpi-viewer src="https://host/live/ROOM#token=…" alt="…"></tmpi-viewer>: a room, in which it moves.
//
//   src              address of a container; where its path ends in /atlas, the server's views beside it serve browsers without a GPU, by the same
//                    link (`?expires=…&signature=…`) where it has one
//   view             address of these views, where it is another
//   alt              what the photo shows; `aria-label` goes before it, `title` is taken without it
//   poster           picture until the photo is there
//   fit              `contain` (as if it were not there): all of the photo; `cover`: as large as fills the element, the rest cut away
//   fullscreen       `off`: no button for full screen
//   loading          `lazy` (as if it were not there): fetched when it comes near the screen; `eager`: at once
//   reveal           `auto` (as if it were not there), or `interaction`: fetched when somebody points at it, touches or focuses it
//   camera-controls  `off`: takes no input
//   auto-rotate      `off`: does not move by itself; so does `still`, without a value
//   motion           how it moves by itself: `swing`, `orbit`, `dolly`, `dolly-zoom`, `zoom` (into the nearest thing), or `none`; without
//                    it, what the photo's owner wants, else `swing`; rooms move by themselves only where this or auto-rotate says so
//   speed            how fast, 0.25 to 4 times the usual
//   settings         `off`: does not ask the server what the photo's owner wants of the camera (how far it goes, where it starts)
//
// `false` is as `off`, since frameworks write that; `still="false"` is as none.
//
// Of a room, whose address (of its page, or below /v1/) stands in `src`, besides:
//
//   room             its name in place of its address; `src` is the server's own address then, this page's without it
//   token            token of who watches, where the address has none behind its # or as a parameter
//   sound            `off`: no button for it; without a value it begins with the first tap or key. It never begins before one
//
// `src`, `room`, `token`, `view`, `alt`, `poster`, `fit`, `loading`, `reveal`, `motion` and `speed` are properties, too, and so are `autoRotate`,
// `cameraControls`, `fullscreen`, `still` and `settings`, which are true or false. They are taken over where they were set before this script
// came. What is set or changed later counts from then on.
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
// share one graphics device; those out of sight sleep, and without WebGPU they give what they are drawn with to those in sight, as a browser has
// only so much of it. Where nothing can be drawn, the poster or the photo stays, and `error` says why.

// beside it is static/, as the server and the package have it
import { Face, NAMES, OFF } from './static/element/face.js';
import { load, MODULES, preload, ROOM_MODULES } from './static/element/modules.js';

/** @import { Viewer } from '../view/viewer.js' */
/** @import { Room } from './room.js' */

/** Path of a room, or of its page. */
const ROOM = /\/live\/[\w-]+\/?$/;
/** Attributes that say what is shown. */
const ADDRESS = new Set(['src', 'room', 'token', 'view']);
/** Attributes that are properties, too, as frameworks set them. */
const PROPERTIES = [...ADDRESS, 'alt', 'poster', 'fit', 'loading', 'reveal', 'motion', 'speed'];

/**
 * Attributes that are on or off, and their properties; React sets a property by the attribute's own name where there is one.
 * @type {Record<string, string>}
 */
const SWITCHES = {
  'auto-rotate': 'autoRotate',
  'camera-controls': 'cameraControls',
  fullscreen: 'fullscreen',
  still: 'still',
  settings: 'settings',
};
const REDUCED = '(prefers-reduced-motion: reduce)';

class TmpiViewer extends HTMLElement {
  static observedAttributes = [
    ...ADDRESS,
    ...NAMES,
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
  /**
   * Whether it is near the screen; null before that is known.
   * @type {boolean | null}
   */
  #visible = null;
  /** Somebody came near it or asked for it: it shows what it is told to from then on. */
  #asked = false;
  #loaded = false;
  #face = new Face(this);
  #reduced = matchMedia(REDUCED);

  constructor() {
    super();
    for (const type of ['pointerenter', 'pointerdown', 'focus']) this.#face.stage.addEventListener(type, () => this.#start());
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
    this.#takeOver();
    this.#describe();
    this.#face.connected();
    this.#seen = new IntersectionObserver((entries) => this.#onSeen(entries[entries.length - 1].isIntersecting), { rootMargin: '200px' });
    this.#seen.observe(this);
    this.#reduced.addEventListener('change', this.#onReduced);
    this.#maybeStart();
  }

  /** Moved within the page by `moveBefore`: it goes on as it is. */
  connectedMoveCallback() {}

  disconnectedCallback() {
    this.#reduced.removeEventListener('change', this.#onReduced);
    this.#seen?.disconnect();
    this.#seen = this.#visible = null;
    this.#asked = false;
    this.#stop();
  }

  #onReduced = () => this.#viewer?.setIdle(this.#movesByItself);

  /** Properties that were set before the script came hide those of the element. */
  #takeOver() {
    for (const name of [...PROPERTIES, ...Object.entries(SWITCHES).flat()].filter((name) => Object.hasOwn(this, name))) {
      const value = Reflect.get(this, name);
      Reflect.deleteProperty(this, name);
      Reflect.set(this, name, value);
    }
  }

  /** @param {string} name */
  attributeChangedCallback(name) {
    if (!this.#seen) return;
    this.#describe();
    if (name === 'still' || name === 'auto-rotate') this.#viewer?.setIdle(this.#movesByItself);
    if ((name === 'motion' || name === 'speed') && this.#viewer) this.#viewer.settings = { ...this.#viewer.settings, ...this.#wander };
    if (ADDRESS.has(name)) {
      this.#stop();
      if (this.#asked) this.#start();
    }
    this.#maybeStart();
  }

  /** Address of what is to be shown, and whether that is a room; null where nothing is named. */
  get #named() {
    const [src, room] = [this.getAttribute('src'), this.getAttribute('room')];
    const url = src || room ? parsed(src ?? '/') : null;
    if (!url) return null;
    if (room) url.pathname = `/live/${encodeURIComponent(room)}`;
    return { room: ROOM.test(url.pathname), address: url.href };
  }

  get #movesByItself() {
    // what is live moves without it
    if (this.#room && !this.hasAttribute('auto-rotate') && !this.hasAttribute('motion')) return false;
    const still = this.getAttribute('still');
    const off =
      (still !== null && !OFF.has(still)) || this.getAttribute('motion') === 'none' || OFF.has(this.getAttribute('auto-rotate') ?? '');
    return !off && !this.#reduced.matches;
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
    else this.#maybeStart();
  }

  /** Nothing is fetched for what nobody scrolls to or asks for, unless the page wants it. */
  #maybeStart() {
    if (this.#asked || this.getAttribute('reveal') === 'interaction') return;
    if (this.#visible || this.getAttribute('loading') === 'eager') this.#start();
  }

  #describe() {
    this.#face.describe(this.#named?.room ? '3D video' : '3D photo');
  }

  async #start() {
    this.#asked = true;
    const named = this.#named;
    if (!named || this.#viewer) return;
    const showing = named.room ? this.#watch(named.address) : this.#show(named.address);
    const viewer = await showing.catch((error) => this.#cannot(error.message));
    if (!viewer) return;
    if (!this.#movesByItself) viewer.setIdle(false);
    if (this.#visible === false) viewer.asleep = true;
    const known = () => viewer.head && this.#face.know(viewer.head);
    let mode = '';
    viewer.addEventListener('photo', () => {
      known();
      this.#face.shown();
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
      this.#face.shown();
      this.#fire('load', detail);
    });
    viewer.addEventListener('pose', () => this.#loaded && this.#fire('camera-change', { pose: viewer.pose }));
    viewer.addEventListener('mode', ({ detail: { mode, reason } }) => mode === 'still' && this.#fire('error', { message: reason }));
    viewer.addEventListener('error', ({ detail }) => {
      // what cannot be had while the photo is shown needs no words over it
      if (viewer.mode === 'failed') this.#face.fail(detail.message);
      this.#fire('error', detail);
    });
  }

  /**
   * Nothing that shows the photo can be had.
   * @param {string} message
   */
  #cannot(message) {
    this.#face.fail(message);
    this.#fire('error', { message });
    return null;
  }

  /**
   * @param {string} type
   * @param {object} detail
   */
  #fire(type, detail) {
    this.dispatchEvent(new CustomEvent(type, { detail }));
  }

  /** Whether a page around it scrolls, which it does not in full screen. */
  #embedded = () => !this.matches(':fullscreen');

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
    const state = OFF.has(this.getAttribute('settings') ?? '') ? undefined : beside(atlas, '/settings');
    this.#viewer = new Viewer(this.#face.stage, {
      atlas,
      view: given ? new URL(given, document.baseURI).href : beside(atlas, '/view'),
      report: beside(atlas, '/report'),
      settings: Promise.resolve(state ? fetchSettings(state) : {}).then((settings) => ({ ...settings, ...this.#wander })),
      embedded: this.#embedded,
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
    const sound = OFF.has(attribute('sound') ?? '') ? 'off' : attribute('sound');
    const named = { address, token: attribute('token'), sound, settings: this.#wander };
    const room = new Room(this.#face.stage, this.#face.shadow, named, {
      fire: (type, detail) => this.#fire(type, detail),
      fail: (message) => this.#face.fail(message),
      embedded: this.#embedded,
    });
    [this.#room, this.#viewer] = [room, room.viewer];
    room.visible = this.#visible ?? true;
    return room.viewer;
  }

  #stop() {
    if (this.#room) this.#room.dispose();
    else this.#viewer?.dispose();
    this.#room = this.#viewer = null;
    this.#loaded = false;
    this.#face.reset();
  }
}

/**
 * An address in the page, or null where it is none.
 * @param {string} address
 */
function parsed(address) {
  try {
    return new URL(address, document.baseURI);
  } catch {
    return null;
  }
}

for (const [attribute, name] of Object.entries(SWITCHES)) {
  const usual = attribute !== 'still';
  /** @type {PropertyDescriptor & ThisType<TmpiViewer>} */
  const property = {
    configurable: true,
    enumerable: true,
    get() {
      const value = this.getAttribute(attribute);
      return value === null ? usual : !OFF.has(value);
    },
    set(value) {
      if (value === null || value === undefined) this.removeAttribute(attribute);
      else this.setAttribute(attribute, value === true ? '' : value === false ? 'off' : String(value));
    },
  };
  for (const key of new Set([attribute, name])) Object.defineProperty(TmpiViewer.prototype, key, property);
}

for (const name of PROPERTIES) {
  Object.defineProperty(TmpiViewer.prototype, name, {
    configurable: true,
    enumerable: true,
    /** @this {TmpiViewer} */
    get() {
      return this.getAttribute(name) ?? '';
    },
    /** @this {TmpiViewer} */
    set(value) {
      if (value === null || value === undefined) this.removeAttribute(name);
      else this.setAttribute(name, String(value));
    },
  });
}

if (!customElements.get('tmpi-viewer')) customElements.define('tmpi-viewer', TmpiViewer);

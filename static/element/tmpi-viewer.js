// <tmpi-viewer src="https://host/v1/photos/ID/atlas" alt="…" poster="…"></tmpi-viewer>: a 3D photo on any page.
// <tmpi-viewer src="https://host/live/ROOM#token=…" alt="…"></tmpi-viewer>: a room, a moving 3D photo.
//
//   src              address of a container. If its path ends in /atlas, browsers without a GPU show the server's views beside it, through
//   the
//                    same link (`?expires=…&signature=…`) if it has one
//   view             address of these views, if it is another
//   alt              description of the photo; `aria-label` goes before it, `title` is the fallback
//   poster           picture until the photo is there
//   fit              `contain` (default): all of the photo; `cover`: fills the element, the rest is cut away
//   fullscreen       `off`: no full-screen button
//   loading          `lazy` (default): fetched when it comes near the screen; `eager`: at once
//   reveal           `auto` (default), or `interaction`: fetched when it is hovered, touched or focused
//   camera-controls  `off`: takes no input
//   auto-rotate      `off`: does not move without input; `still`, without a value, does the same
//   motion           how it moves without input: `swing`, `orbit`, `dolly`, `dolly-zoom`, `zoom` (into the nearest thing), or `none`. The
//                    default is the owner's setting, else `swing`. A room moves only if this or auto-rotate is set
//   speed            how fast, 0.25 to 4 times the default
//   settings         `off`: does not fetch the owner's camera settings (range, start) from the server
//
// `false` means `off`, since frameworks write that; `still="false"` is as if it were missing.
//
// A room's address in `src` is that of its page, or the one below /v1/. It has these attributes besides:
//
//   room             name of the room, in place of its address; `src` is then the server's address, by default this page's server
//   token            the viewer's token, if the address has none behind its # or as a parameter
//   sound            `off`: no sound button; without a value, sound starts with the first tap or key, never earlier
//
// `src`, `room`, `token`, `view`, `alt`, `poster`, `fit`, `loading`, `reveal`, `motion` and `speed` are also properties. So are the
// booleans `autoRotate`, `cameraControls`, `fullscreen`, `still` and `settings`. Properties set before this script loads are taken over.
// Later changes take effect at once.
//
// Names, properties (`loaded`), methods (`toBlob`, `resetView`) and events follow <model-viewer> where it has them. One difference:
// `camera-controls` and `auto-rotate` are on by default, because a 3D photo that stands still is a photo.
//
// A room has the properties `state` and `sound`, and `setSound(on)`. Call that from a tap; it rejects if the browser does not allow it. An
// element out of sight fetches nothing, unless its sound is on. It reconnects after a broken connection.
//
// Slots: `poster` takes the page's own picture in place of `poster` (`<img slot="poster" …>`, which browsers show without scripts, too);
// `error` takes content to show if the photo cannot be shown, by default `alt` and the reason. CSS parts: `fullscreen`, `error`; for rooms
// also `sound` and `note`, which says why there is no picture yet.
//
// Fires `progress` {received, total, totalProgress}, `load` {mode}, `camera-change` {pose} and `error` {message}. Rooms have no progress,
// and also fire `state` {state, reason}, `statistics` {behind, frames, kbits, viewers, …} twice a second, and `sound` {on}. The states are
// `connecting`, `waiting` (no publisher), `full` (viewer limit reached), `live`, `stalled`, `ended`, `away` (server unreachable), `refused`
// (no valid token), `none` (no such room) and `unsupported` (no decoder for its video).
//
// The element is as wide as its place and has the photo's shape once that is known (16 / 10 before), unless CSS sets `aspect-ratio` or
// `height`. All elements of a page share one graphics device. Elements out of sight sleep; without WebGPU they also give up their drawing
// contexts, which browsers limit. If nothing can be drawn, the poster or the photo stays, and `error` says why.

// static/ is beside this file, both on the server and in the package
import { load, MODULES, preload, ROOM_MODULES } from './static/element/modules.js';
import { NAMES, OFF, ShadowTree } from './static/element/shadow-tree.js';
import { word } from './static/i18n/element.js';

/** @import { Viewer } from '../view/viewer.js' */
/** @import { Room } from './room.js' */

/** Path of a room or of its page. */
const ROOM = /\/live\/[\w-]+\/?$/;
/** Attributes that say what is shown. */
const ADDRESS = new Set(['src', 'room', 'token', 'view']);
/** Attributes that are also properties, as frameworks set them. */
const PROPERTIES = [...ADDRESS, 'alt', 'poster', 'fit', 'loading', 'reveal', 'motion', 'speed'];

/**
 * Boolean attributes and their properties. React sets a property of the attribute's own name if there is one.
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
   * The room, if one is shown.
   * @type {Room | null}
   */
  #room = null;
  /** @type {IntersectionObserver | null} */
  #seen = null;
  /**
   * Whether it is near the screen; null until that is known.
   * @type {boolean | null}
   */
  #visible = null;
  /** It has come near the screen or had input: from then on it shows its content. */
  #asked = false;
  #loaded = false;
  #tree = new ShadowTree(this);
  #reduced = matchMedia(REDUCED);

  constructor() {
    super();
    for (const type of ['pointerenter', 'pointerdown', 'focus']) this.#tree.stage.addEventListener(type, () => this.#start());
  }

  /** The viewer; null before it has started. */
  get viewer() {
    return this.#viewer;
  }

  /** True once the scene is shown. */
  get loaded() {
    return this.#loaded;
  }

  /** State of the room; empty for a photo. */
  get state() {
    return this.#room?.state ?? '';
  }

  /** True while a room's sound is played. */
  get sound() {
    return this.#room?.sound ?? false;
  }

  /** Sets the attribute of that name: React sets a property if there is one. */
  set sound(/** @type {boolean | string | null | undefined} */ value) {
    setSwitch(this, 'sound', value);
  }

  /**
   * Turns a room's sound on or off. Turn it on only from a tap.
   * @param {boolean} on
   */
  async setSound(on) {
    if (!this.#room) throw new Error('no room is shown');
    await this.#room.setSound(on);
  }

  /** The current view as a PNG file, in the photo's size. */
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
    this.#tree.connected();
    this.#seen = new IntersectionObserver((entries) => this.#onSeen(entries[entries.length - 1].isIntersecting), { rootMargin: '200px' });
    this.#seen.observe(this);
    this.#reduced.addEventListener('change', this.#onReduced);
    this.#maybeStart();
  }

  /** `moveBefore` moved it within the page: nothing changes. */
  connectedMoveCallback() {}

  /** To sort a list or change an element's parent, scripts remove it and insert it again at once: then it goes on. */
  disconnectedCallback() {
    this.#reduced.removeEventListener('change', this.#onReduced);
    this.#seen?.disconnect();
    this.#seen = this.#visible = null;
    queueMicrotask(() => {
      if (this.isConnected) return;
      this.#asked = false;
      this.#stop();
    });
  }

  #onReduced = () => this.#viewer?.setIdle(this.#movesByItself);

  /** Properties set before the script loaded hide the element's own. */
  #takeOver() {
    for (const name of [...PROPERTIES, 'sound', ...Object.entries(SWITCHES).flat()].filter((name) => Object.hasOwn(this, name))) {
      const value = Reflect.get(this, name);
      Reflect.deleteProperty(this, name);
      Reflect.set(this, name, value);
    }
  }

  /**
   * @param {string} name
   * @param {string | null} old
   * @param {string | null} value
   */
  attributeChangedCallback(name, old, value) {
    // frameworks may set a value again
    if (old === value) return;
    if (name === 'still' || name === 'auto-rotate') this.#viewer?.setIdle(this.#movesByItself);
    if ((name === 'motion' || name === 'speed') && this.#viewer) this.#viewer.settings = { ...this.#viewer.settings, ...this.#wander };
    if (ADDRESS.has(name)) {
      this.#stop();
      // it has left the page: wherever it comes back to decides
      if (!this.#seen) this.#asked = false;
    }
    if (!this.#seen) return;
    this.#describe();
    if (ADDRESS.has(name) && this.#asked) this.#start();
    else this.#maybeStart();
  }

  /** Address to show, and whether it is a room; null without one. */
  get #named() {
    const [src, room] = [this.getAttribute('src'), this.getAttribute('room')];
    const url = src || room ? parsed(src || '/') : null;
    if (!url) return null;
    if (room) url.pathname = `${url.pathname.replace(/\/$/, '')}/live/${encodeURIComponent(room)}`;
    return { room: ROOM.test(url.pathname), address: url.href };
  }

  get #movesByItself() {
    // a room moves anyway
    if (this.#room && !this.hasAttribute('auto-rotate') && !this.hasAttribute('motion')) return false;
    const still = this.getAttribute('still');
    const off =
      (still !== null && !OFF.has(still)) || this.getAttribute('motion') === 'none' || OFF.has(this.getAttribute('auto-rotate') ?? '');
    return !off && !this.#reduced.matches;
  }

  /** Settings of the attributes for motion (view/settings.js). */
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

  /** Starts near the screen, or at once with `loading="eager"`; with `reveal="interaction"`, not before input. */
  #maybeStart() {
    if (this.#asked || this.getAttribute('reveal') === 'interaction') return;
    if (this.#visible || this.getAttribute('loading') === 'eager') this.#start();
  }

  #describe() {
    this.#tree.describe(this.#named?.room ? word('3D video') : word('3D photo'));
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
    const known = () => viewer.head && this.#tree.know(viewer.head);
    let mode = '';
    viewer.addEventListener('photo', () => {
      known();
      this.#tree.shown();
    });
    viewer.addEventListener('progress', ({ detail }) =>
      this.#fire('progress', { ...detail, totalProgress: detail.total ? detail.received / detail.total : 0 }),
    );
    viewer.addEventListener('ready', ({ detail }) => {
      // a room's viewer starts again when its scene needs more room: not an event for the page
      if (this.#room && mode === detail.mode) return;
      mode = detail.mode;
      this.#loaded = true;
      known();
      this.#tree.shown();
      this.#fire('load', detail);
    });
    viewer.addEventListener('pose', () => this.#loaded && this.#fire('camera-change', { pose: viewer.pose }));
    viewer.addEventListener('mode', ({ detail: { mode, reason } }) => mode === 'still' && this.#fire('error', { message: reason }));
    viewer.addEventListener('error', ({ detail }) => {
      // failures while the photo is shown need no message over it
      if (viewer.mode === 'failed') this.#tree.fail(detail.message);
      this.#fire('error', detail);
    });
  }

  /**
   * Shows that the photo cannot be shown, and fires `error`.
   * @param {string} message
   */
  #cannot(message) {
    this.#tree.fail(message);
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

  /** Whether the page around it scrolls, which it does not in full screen. */
  #embedded = () => !this.matches(':fullscreen');

  /**
   * True if that address is still to be shown and nothing is shown yet.
   * @param {string} address
   */
  #wants(address) {
    return !this.#viewer && this.isConnected && this.#named?.address === address;
  }

  /**
   * A viewer that shows a photo; null if another address is wanted by now.
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
    this.#viewer = new Viewer(this.#tree.stage, {
      atlas,
      view: given ? new URL(given, document.baseURI).href : beside(atlas, '/view'),
      report: beside(atlas, '/report'),
      settings: Promise.resolve(state ? fetchSettings(state) : {}).then((settings) => ({ ...settings, ...this.#wander })),
      embedded: this.#embedded,
    });
    return this.#viewer;
  }

  /**
   * A viewer that shows a room; null if another address is wanted by now.
   * @param {string} address
   */
  async #watch(address) {
    preload([...MODULES, ...ROOM_MODULES]);
    const { Room } = /** @type {typeof import('./room.js')} */ (await load('element/room.js'));
    if (!this.#wants(address)) return null;
    const attribute = (/** @type {string} */ name) => this.getAttribute(name);
    const sound = OFF.has(attribute('sound') ?? '') ? 'off' : attribute('sound');
    const named = { address, token: attribute('token'), sound, settings: this.#wander };
    const room = new Room(this.#tree.stage, this.#tree.shadow, named, {
      fire: (type, detail) => this.#fire(type, detail),
      fail: (message) => this.#tree.fail(message),
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
    this.#tree.reset();
  }
}

/**
 * Parses an address relative to the page; null if it is not valid.
 * @param {string} address
 */
function parsed(address) {
  try {
    return new URL(address, document.baseURI);
  } catch {
    return null;
  }
}

/**
 * Sets an attribute that is on or off, or removes it.
 * @param {HTMLElement} element
 * @param {string} attribute
 * @param {boolean | string | null | undefined} value
 */
function setSwitch(element, attribute, value) {
  if (value === null || value === undefined) element.removeAttribute(attribute);
  else element.setAttribute(attribute, value === true ? '' : value === false ? 'off' : String(value));
}

for (const [attribute, name] of Object.entries(SWITCHES)) {
  const defaultValue = attribute !== 'still';
  /** @type {PropertyDescriptor & ThisType<TmpiViewer>} */
  const property = {
    configurable: true,
    enumerable: true,
    get() {
      const value = this.getAttribute(attribute);
      return value === null ? defaultValue : !OFF.has(value);
    },
    set(value) {
      setSwitch(this, attribute, value);
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

// The element's shadow tree: the viewer's stage, the poster below it, the full-screen button and the error box. Also sets the element's
// aspect ratio and its name.
import { word } from '../i18n/element.js';

import { Sheet } from './style-sheet.js';

const STYLE = `
  :host { display: block; position: relative; overflow: hidden; aspect-ratio: var(--tmpi-shape, 16 / 10); }
  :host([hidden]), [hidden] { display: none !important; }
  :host(:fullscreen) { background: #000; }
  .room { position: absolute; inset: 0; container-type: size; overflow: hidden; }
  .stage { position: absolute; inset: 0; cursor: grab; touch-action: pan-y; user-select: none; }
  :host(:fullscreen) .stage { touch-action: none; }
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
  .error .reason { opacity: 0.85; font-size: 0.9em; }
  .error .reason::first-letter { text-transform: uppercase; }
  .error:not([hidden]) ~ button { display: none; }
`;
const CORNERS = 'M3 9V3h6M15 3h6v6M21 15v6h-6M9 21H3v-6';
/** Attributes that name it; the first that is not empty counts. */
export const NAMES = ['aria-label', 'alt', 'title'];
/** Values that turn off what is on by default. */
export const OFF = new Set(['off', 'false']);

export class ShadowTree {
  #host;
  #sheet;
  #poster = make('img', 'poster');
  #posterSlot = make('slot', '', this.#poster);
  #error = errorBox();
  #full = fullscreenButton(() => this.#toggleFullscreen());
  /** Holds the viewer and takes the input. */
  stage = make('div', 'stage');
  /** True once the photo's own shape is known. */
  shaped = false;

  /** @param {HTMLElement} host */
  constructor(host) {
    this.#host = host;
    this.shadow = host.attachShadow({ mode: 'open' });
    new Sheet(this.shadow).text = STYLE;
    this.#sheet = new Sheet(this.shadow);
    this.#poster.alt = '';
    this.#poster.loading = 'lazy';
    this.#posterSlot.name = 'poster';
    // any poster gives the photo's shape before the photo is there
    this.#posterSlot.addEventListener('load', ({ target }) => this.#pictureLoaded(target), true);
    host.addEventListener('load', ({ target }) => this.#pictureLoaded(target), true);
    this.stage.tabIndex = 0;
    this.stage.setAttribute('role', 'application');
    this.shadow.append(make('div', 'room', this.#posterSlot, this.stage), this.#error, this.#full);
  }

  /** Reads the content that the page put into the element. */
  connected() {
    // a slotted poster may have loaded already
    this.#shapeOf(this.#host.querySelector('[slot=poster]'));
  }

  /**
   * A poster may load after the photo has failed.
   * @param {EventTarget | null} picture
   */
  #pictureLoaded(picture) {
    this.#shapeOf(picture);
    if (this.#posterVisible) this.#error.hidden = true;
  }

  /**
   * Takes over the shape of a picture of the photo.
   * @param {EventTarget | null} picture
   */
  #shapeOf(picture) {
    if (picture instanceof HTMLImageElement && !this.shaped) this.#shape(picture.naturalWidth, picture.naturalHeight);
  }

  /**
   * The element's shape unless CSS sets another.
   * @param {number} width
   * @param {number} height
   */
  #shape(width, height) {
    if (width > 0 && height > 0) this.#sheet.text = `:host { --tmpi-shape: ${width} / ${height}; }`;
  }

  /**
   * Takes over the photo's own shape.
   * @param {{width: number, height: number}} photo
   */
  know({ width, height }) {
    this.shaped = true;
    this.#shape(width, height);
  }

  async #toggleFullscreen() {
    try {
      if (document.fullscreenElement === this.#host) await document.exitFullscreen();
      else await this.#host.requestFullscreen();
    } catch {
      // the page, or its frame's policy, does not allow it
      this.#full.hidden = true;
    }
  }

  /** The page's name for it, or ''. */
  get #name() {
    return NAMES.map((name) => this.#host.getAttribute(name)?.trim()).find(Boolean) ?? '';
  }

  /**
   * Follows the attributes.
   * @param {string} kind of the content, in words
   */
  describe(kind) {
    const attribute = (/** @type {string} */ name) => this.#host.getAttribute(name) ?? '';
    this.stage.setAttribute('aria-label', this.#name || kind);
    this.stage.setAttribute('aria-roledescription', kind);
    // the stage takes the input; when it is inert, the page scrolls and clicks as over a picture
    this.stage.inert = OFF.has(attribute('camera-controls'));
    this.#full.hidden = !document.fullscreenEnabled || OFF.has(attribute('fullscreen'));
    const alt = this.#error.querySelector('p');
    if (alt) [alt.textContent, alt.hidden] = [this.#name, !this.#name];
    const poster = attribute('poster');
    if (poster) this.#poster.src = poster;
    else this.#poster.removeAttribute('src');
  }

  /** Whether there is a loaded poster, and nothing above it. */
  get #posterVisible() {
    if (this.#posterSlot.hidden) return false;
    const given = this.#host.querySelector('[slot=poster]');
    return given instanceof HTMLImageElement ? given.naturalWidth > 0 : Boolean(given) || this.#poster.naturalWidth > 0;
  }

  /**
   * Shows the photo's description and the reason, unless a poster is visible.
   * @param {string} reason
   */
  fail(reason) {
    if (this.#posterVisible) return;
    const why = this.#error.querySelector('.reason');
    if (why) why.textContent = reason;
    this.#error.hidden = false;
  }

  /** Hides the poster. */
  shown() {
    this.#posterSlot.hidden = true;
  }

  /** Back to the state before anything was shown. */
  reset() {
    this.shaped = false;
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

/** Shown if the photo cannot be: the page's own content, or the photo's description and the reason. */
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
  button.setAttribute('aria-label', word('Full screen'));
  button.addEventListener('click', onClick);
  return button;
}

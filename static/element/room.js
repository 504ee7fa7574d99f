// A room in the element: its picture, a note while there is no picture, and its sound.
import { t } from '../i18n/messages.js';
import { roomAt } from '../live/room-address.js';
import { pictureDelay, statusText } from '../live/room-status.js';
import { SoundPlayer } from '../live/sound-player.js';
import { startRoom } from '../live/start.js';
import { Viewer } from '../view/viewer.js';
import { Sheet } from './style-sheet.js';

const STYLE = `
  .note {
    position: absolute; inset: auto 0 8px; width: fit-content; max-width: calc(100% - 128px); margin: 0 auto; padding: 6px 14px;
    box-sizing: border-box; border-radius: 16px; background: rgb(0 0 0 / 65%); color: #fff; font: 14px/1.4 system-ui, sans-serif;
    text-align: center; pointer-events: none;
  }
  .note:empty { display: none; }
  .sound { right: 56px; }
  .sound[aria-pressed='true'] { opacity: 1; }
  .sound[aria-pressed='false'] .waves { display: none; }
`;
const SPEAKER = ['M4 9.5v5h3.5L12 18.5v-13L7.500 9.5z', 'M15.500 9a4.200 4.200 0 0 1 0 6M18 6.500a7.800 7.800 0 0 1 0 11'];

/**
 * What the room needs of the element: fires an event, shows an error in place of the picture, and says whether the page around it scrolls.
 * @typedef {{fire: (type: string, detail: object) => void, fail: (message: string) => void, embedded: () => boolean}} Element
 */

export class Room {
  #element;
  #player = new SoundPlayer();
  #note = document.createElement('p');
  #button = document.createElement('button');
  #shadow;
  #sheet;
  #visible = true;
  #shown = false;
  /** The shown picture has no depth yet. */
  #early = false;
  #listens = false;
  #gone = new AbortController();
  /** A state of the worker (live/connection.js), or `live`, `stalled` or `ended`. */
  state = 'connecting';
  #reason = '';

  /**
   * @param {HTMLElement} stage that the picture is put into
   * @param {ShadowRoot} shadow that the rest is put into
   * @param {{address: string, token: string | null, sound: string | null, settings: object}} named address of the room or its page, the
   *   element's attributes, and its settings for motion (view/settings.js)
   * @param {Element} element
   */
  constructor(stage, shadow, named, element) {
    this.#element = element;
    this.#shadow = shadow;
    this.#sheet = new Sheet(shadow);
    this.#dress(named.sound === 'off');
    const { address, token } = roomAt(named.address, named.token);
    this.viewer = new Viewer(stage, {
      live: { start: startRoom, address, token },
      settings: named.settings,
      embedded: element.embedded,
    });
    this.viewer.addEventListener('live', ({ detail }) => this.#onLive(detail));
    this.viewer.addEventListener('ready', ({ detail }) => {
      this.#shown = true;
      this.#early = Boolean(detail.early);
      this.#say();
    });
    const { signal } = this.#gone;
    document.addEventListener('visibilitychange', () => this.#tellHidden(), { signal });
    if (named.sound === null || named.sound === 'off') return;
    // browsers play no sound before a user gesture
    const begin = () => this.#listens || this.setSound(true).catch(() => {});
    for (const type of ['click', 'keydown']) stage.addEventListener(type, begin, { once: true, signal });
  }

  /** @param {boolean} silent without a button for sound */
  #dress(silent) {
    this.#sheet.text = STYLE;
    this.#note.className = 'note';
    this.#note.setAttribute('role', 'status');
    this.#note.part.add('note');
    const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
    svg.setAttribute('viewBox', '0 0 24 24');
    svg.setAttribute('aria-hidden', 'true');
    SPEAKER.forEach((d, i) => {
      const path = document.createElementNS(svg.namespaceURI, 'path');
      path.setAttribute('d', d);
      if (i) path.setAttribute('class', 'waves');
      svg.append(path);
    });
    const button = this.#button;
    button.type = 'button';
    button.className = 'sound';
    button.hidden = true;
    button.part.add('sound');
    button.setAttribute('aria-label', t('Sound'));
    button.setAttribute('aria-pressed', 'false');
    button.append(svg);
    button.addEventListener('click', () => this.setSound(!this.#listens).catch(() => {}));
    this.#shadow.append(this.#note, ...(silent ? [] : [button]));
    this.#say();
  }

  /** True while the sound is played. */
  get sound() {
    return this.#listens;
  }

  /**
   * Turns the sound on or off. Turn it on only from a tap. Rejects if the browser does not allow it.
   * @param {boolean} on
   */
  async setSound(on) {
    if (on) await this.#player.start();
    else await this.#player.stop();
    if (this.#gone.signal.aborted) return;
    this.#listens = on;
    this.viewer.postToWorker({ sound: on });
    this.#button.setAttribute('aria-pressed', String(on));
    this.#element.fire('sound', { on });
  }

  /** Whether the element is in sight: a hidden element fetches nothing but sound that is on. */
  set visible(/** @type {boolean} */ on) {
    this.#visible = on;
    this.#tellHidden();
  }

  #tellHidden() {
    this.viewer.postToWorker({ hidden: document.hidden || !this.#visible });
  }

  /** @param {any} told by the room's worker */
  #onLive({ type, ...told }) {
    if (type === 'state') this.#onState(told);
    else if (type === 'statistics') {
      this.#player.late = pictureDelay(told) / 1000;
      if (this.state === 'live') this.#element.fire('statistics', { ...told, behind: pictureDelay(told) });
    } else if (type === 'sound') this.#player.play(told);
    else if (type === 'has-sound') this.#button.hidden = !told.on;
  }

  /** @param {import('../live/room-status.js').RoomState} told */
  #onState(told) {
    [this.state, this.#reason] = [told.state, told.reason];
    this.#say();
    this.#element.fire('state', told);
    const { over, text } = statusText(told);
    if (!over) return;
    this.#note.textContent = '';
    this.#element.fail(text);
    this.#element.fire('error', { message: text });
  }

  /** Shows why there is no picture, or that the picture has no depth yet. */
  #say() {
    const { over, text } = statusText({ state: this.state, reason: this.#reason });
    const seen = this.#shown && this.state === 'live';
    this.#note.textContent = over ? '' : !seen ? text : this.#early ? t('The picture has no depth yet.') : '';
  }

  dispose() {
    this.#gone.abort();
    this.viewer.dispose();
    this.#player.close();
    this.#note.remove();
    this.#button.remove();
    this.#sheet.remove();
  }
}

// The row of a photo that is being uploaded or made.

import { sentence } from '../i18n/format.js';
import { t } from '../i18n/messages.js';
import { $, at, element, icon } from './dom.js';

/**
 * Announces a message to screen readers.
 * @param {string} text
 */
export function say(text) {
  $('status').textContent = text;
}

export class Row {
  /** @type {'open' | 'done' | 'failed'} */
  kind = 'open';
  /** Progress, 0 to 1. */
  share = 0;
  #picture;
  /** @type {string | null} */
  #address = null;

  /**
   * @param {string} name
   * @param {File | null} preview
   * @param {() => void} changed called when there is something else to see
   */
  constructor(name, preview, changed) {
    this.name = name;
    this.preview = preview;
    this.changed = changed;
    this.state = element('p', 'upload-state');
    this.bar = element('progress');
    this.bar.max = 1;
    this.bar.value = 0;
    this.bar.setAttribute('aria-label', t('Progress of {0}', name));
    this.close = element('button', 'round', icon('close'));
    this.close.type = 'button';
    this.close.setAttribute('aria-label', t('Cancel {0}', name));
    /** A note for when the photo is ready. */
    this.note = '';
    /** @type {(() => void) | undefined} */
    this.onClose = undefined;
    this.close.addEventListener('click', () => this.onClose?.());
    this.actions = element('div', 'upload-actions', this.close);
    const body = element('div', 'upload-body', element('p', 'upload-name', name), this.bar, this.state);
    this.#picture = element('span', 'upload-picture');
    this.root = element('li', 'upload', this.#picture, body, this.actions);
    this.root.hidden = true;
    $('upload-list').append(this.root);
  }

  /** True while the pointer or the focus is on it: it is not removed then. */
  get attended() {
    return this.root.matches(':hover, :focus-within');
  }

  /**
   * Whether it is visible; its picture is read only then.
   * @param {boolean} on
   */
  set shown(on) {
    this.root.hidden = !on;
    if (!on || !this.preview || this.#address) return;
    this.#address = URL.createObjectURL(this.preview);
    const image = element('img', 'upload-picture');
    image.alt = '';
    // if the browser cannot show the picture, its frame stays empty
    image.addEventListener('load', () => this.#picture.replaceWith(image));
    image.src = this.#address;
  }

  /**
   * @param {string} text
   * @param {number} [share]
   */
  show(text, share) {
    this.state.textContent = text;
    if (share !== undefined) this.bar.value = this.share = share;
    this.changed();
  }

  /** @param {string} message */
  fail(message) {
    this.kind = 'failed';
    this.root.classList.add('failed');
    this.bar.hidden = true;
    this.state.textContent = sentence(message);
    this.close.setAttribute('aria-label', t('Dismiss {0}', this.name));
    this.onClose = () => this.remove();
    say(`${this.name}: ${message}`);
    this.changed();
  }

  /** @param {string} id */
  done(id) {
    this.kind = 'done';
    this.bar.hidden = true;
    this.state.textContent = this.note ? `${t('Ready')}. ${this.note}` : t('Ready');
    const open = element('a', 'button primary', t('Open'));
    open.href = at(`/view/${encodeURIComponent(id)}`);
    open.setAttribute('aria-label', t('Open {0}', this.name));
    this.actions.replaceChildren(open);
    say(t('{0} is ready.', this.name));
    this.changed();
  }

  remove() {
    this.root.remove();
    if (this.#address) URL.revokeObjectURL(this.#address);
    this.changed();
  }
}

// A row of the page while a photo is on its way.
import { t } from '../i18n/messages.js';
import { sentence } from '../i18n/text.js';
import { $, element, icon } from './dom.js';

/**
 * Tells something to those who do not see the page.
 * @param {string} text
 */
export function say(text) {
  $('status').textContent = text;
}

export class Row {
  /**
   * @param {string} name
   * @param {File | null} preview
   */
  constructor(name, preview) {
    this.name = name;
    this.preview = preview && URL.createObjectURL(preview);
    this.state = element('p', 'upload-state');
    this.bar = element('progress');
    this.bar.max = 1;
    this.bar.value = 0;
    this.bar.setAttribute('aria-label', t('Progress of {0}', name));
    this.close = element('button', 'round', icon('close'));
    this.close.type = 'button';
    this.close.setAttribute('aria-label', t('Cancel {0}', name));
    /** @type {(() => void) | undefined} */
    this.onClose = undefined;
    this.close.addEventListener('click', () => this.onClose?.());
    this.actions = element('div', 'upload-actions', this.close);
    const body = element('div', 'upload-body', element('p', 'upload-name', name), this.bar, this.state);
    this.root = element('li', 'upload', previewOf(this.preview), body, this.actions);
    $('upload-list').prepend(this.root);
    $('uploads').hidden = false;
  }

  /**
   * @param {string} text
   * @param {number} [share]
   */
  show(text, share) {
    this.state.textContent = text;
    if (share !== undefined) this.bar.value = share;
  }

  /** @param {string} message */
  fail(message) {
    this.root.classList.add('failed');
    this.bar.hidden = true;
    this.state.textContent = sentence(message);
    this.close.setAttribute('aria-label', t('Dismiss {0}', this.name));
    this.onClose = () => this.remove();
    say(`${this.name}: ${message}`);
  }

  /** @param {string} id */
  done(id) {
    this.bar.hidden = true;
    this.state.textContent = t('Ready');
    const open = element('a', 'button primary', t('Open'));
    open.href = `/view/${encodeURIComponent(id)}`;
    open.setAttribute('aria-label', t('Open {0}', this.name));
    this.actions.replaceChildren(open);
    say(t('{0} is ready.', this.name));
  }

  remove() {
    this.root.remove();
    if (this.preview) URL.revokeObjectURL(this.preview);
    $('uploads').hidden = !$('upload-list').children.length;
  }
}

/**
 * A small picture, or an empty frame where there is none to show.
 * @param {string | null} address
 */
function previewOf(address) {
  const empty = element('span', 'upload-picture');
  if (!address) return empty;
  const image = element('img', 'upload-picture');
  image.alt = '';
  image.addEventListener('error', () => image.replaceWith(empty));
  image.src = address;
  return image;
}

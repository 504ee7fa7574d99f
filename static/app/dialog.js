// Common parts of the sharing dialogs.

import { t } from '../i18n/messages.js';
import { element } from './dom.js';

/** @import { Photo } from './api.js' */
/** @import { Viewer } from '../view/viewer.js' */

const COPIED_MS = 2000;

/**
 * What is shared: the photo's id, its current viewer, its name, the prefix of file names, its visibility on a server with access control,
 * and what to do when that was changed.
 * @typedef {{id: string, viewer: Viewer, name: string, file: string, visibility?: 'private' | 'link',
 *   changed: (answer: {state: Photo, etag: string | null}) => void}} Shared
 */

let styled = false;

/** Fetches the dialogs' style sheet, once. */
async function style() {
  if (styled) return;
  styled = true;
  const link = document.createElement('link');
  link.rel = 'stylesheet';
  link.href = new URL('./share.css', import.meta.url).href;
  const there = new Promise((resume) => {
    link.addEventListener('load', resume);
    link.addEventListener('error', resume);
  });
  document.head.append(link);
  await there;
}

/**
 * Shows a dialog with a heading and a close button; removes it once it is closed.
 * @param {string} title
 * @param {(Node | string)[]} content
 */
export async function showDialog(title, ...content) {
  await style();
  const heading = element('h2', '', title);
  heading.id = 'share-title';
  // not the first field: it would open the on-screen keyboard
  heading.tabIndex = -1;
  heading.autofocus = true;
  const dialog = element('dialog', 'share-dialog', heading, ...content);
  dialog.setAttribute('aria-labelledby', heading.id);
  const close = button(t('Close'), () => dialog.close());
  // beside the dialog's own buttons, if it has any
  const actions = dialog.querySelector('.actions');
  if (actions) actions.append(close);
  else dialog.append(element('div', 'row', close));
  dialog.addEventListener('close', () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  return dialog;
}

/**
 * @param {string} text
 * @param {() => void} onClick
 * @param {string} [kind] further classes
 */
export function button(text, onClick, kind = '') {
  const out = element('button', `button ${kind}`.trim(), text);
  out.type = 'button';
  out.addEventListener('click', onClick);
  return out;
}

/**
 * Text to copy: a field that shows it, and a row with the button.
 * @param {string} title what it is
 * @param {string} value
 */
export function copied(title, value) {
  const text = element('textarea');
  text.readOnly = true;
  text.spellcheck = false;
  text.value = value;
  text.setAttribute('aria-label', title);
  const copy = button(t('Copy'), async () => {
    try {
      await navigator.clipboard.writeText(text.value);
      say(t('Copied'));
      setTimeout(() => say(t('Copy')), COPIED_MS);
    } catch {
      // no clipboard without TLS: select the text for the keyboard
      text.focus();
      text.select();
    }
  });
  /** @param {string} word */
  function say(word) {
    copy.textContent = word;
    copy.setAttribute('aria-label', `${word}: ${title}`);
  }
  say(t('Copy'));
  return { text, parts: [text, element('div', 'row', copy)] };
}

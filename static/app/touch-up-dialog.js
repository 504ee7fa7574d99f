// The controls of the touch-up dialog.

import { t } from '../i18n/messages.js';
import { at, element } from './dom.js';

const STYLE = at('/static/app/touch-up.css');

/** Resolves when the style sheet has loaded, so that the dialog never appears without it. */
function style() {
  if (document.querySelector(`link[href="${STYLE}"]`)) return Promise.resolve();
  const link = element('link');
  link.rel = 'stylesheet';
  link.href = STYLE;
  return new Promise((resolve) => {
    link.onload = link.onerror = () => resolve(undefined);
    document.head.append(link);
  });
}

/**
 * @param {string} id
 * @param {string} text
 * @param {string} [className]
 */
function button(id, text, className = 'button') {
  const made = element('button', className, text);
  made.id = id;
  made.type = 'button';
  return made;
}

/**
 * @param {string} id
 * @param {[number, number, number, number]} range least, greatest, step, value
 * @param {string} text
 */
function slider(id, [min, max, step, value], text) {
  const input = element('input');
  Object.assign(input, { id, type: 'range', min, max, step, value });
  return element('label', 'slide', element('span', '', text), input);
}

/**
 * @param {string} value
 * @param {string} text
 */
function wish(value, text) {
  const input = element('input');
  Object.assign(input, { type: 'radio', name: 'touch-wish', value });
  if (value === 'by') input.defaultChecked = true;
  return element('label', '', input, element('span', '', text));
}

/**
 * @param {string} id
 * @param {string} text
 * @param {string} under
 */
function picture(id, text, under) {
  const canvas = element('canvas');
  canvas.id = id;
  canvas.setAttribute('aria-label', text);
  return element('figure', '', canvas, element('figcaption', '', under));
}

/**
 * The dialog with its controls, added to the page but not shown yet.
 * @returns {Promise<HTMLDialogElement>}
 */
export async function touchUpDialog() {
  await style();
  const title = element('h2', '', t('Touch up the depth'));
  title.id = 'touch-title';
  const status = element('p', 'hint');
  status.id = 'touch-status';
  status.setAttribute('role', 'status');
  const photo = picture(
    'touch-photo',
    t('The photo: arrow keys move the brush, with shift in small steps; space puts it down and up'),
    t('The photo'),
  );
  const canvas = /** @type {HTMLCanvasElement} */ (photo.firstChild);
  canvas.tabIndex = 0;
  canvas.setAttribute('role', 'application');
  const depth = picture('touch-depth', t('The depth that comes of it: near is bright'), t('Its depth: near is bright'));
  depth.firstElementChild?.setAttribute('role', 'img');
  const form = element(
    'form',
    'wishes',
    wish('by', t('Nearer or farther')),
    wish('like', t('As near as a place')),
    wish('far', t('Far away, like the sky')),
  );
  form.id = 'touch-form';
  form.setAttribute('role', 'radiogroup');
  form.setAttribute('aria-label', t('Depth of what is painted'));
  form.addEventListener('submit', (event) => event.preventDefault());
  const dialog = element(
    'dialog',
    'touch-up',
    element('header', '', title, status),
    element('div', 'pictures', photo, depth),
    element(
      'div',
      'controls',
      form,
      slider('touch-amount', [-0.6, 0.6, 0.01, 0.15], t('Farther to nearer')),
      slider('touch-size', [0.005, 0.2, 0.005, 0.04], t('Size of the brush')),
      element(
        'div',
        'buttons',
        button('touch-undo', t('Undo')),
        button('touch-redo', t('Redo')),
        button('touch-clear', t('Remove all')),
        button('touch-cancel', t('Cancel')),
        button('touch-save', t('Save with the photo'), 'button primary'),
      ),
    ),
  );
  dialog.setAttribute('aria-labelledby', 'touch-title');
  document.body.append(dialog);
  return dialog;
}

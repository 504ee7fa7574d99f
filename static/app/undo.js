// Deletions that wait a little, so that they can be taken back.

import { t } from '../i18n/messages.js';
import { deletePhoto } from './api.js';
import { element } from './dom.js';

/** Time to change one's mind. */
const WAIT_MS = 6000;

/** Deletions that wait, by photo. */
const waiting = new Map();
/** @type {{id: string, bar: HTMLElement} | null} */
let shown = null;

/** True while the photo is to be deleted. */
export const isGoing = (id) => waiting.has(id);

/**
 * Deletes a photo after a while, unless it is undone.
 * @param {string} id
 * @param {string} name
 * @param {{gone: () => void, back: (reason?: string) => void}} then called when it is deleted, or when it stays
 */
export function deleteLater(id, name, then) {
  const timer = setTimeout(() => run(id), WAIT_MS);
  waiting.set(id, { timer, then });
  show(id, name);
}

async function run(id, options) {
  const { timer, then } = waiting.get(id);
  clearTimeout(timer);
  if (shown?.id === id) hide();
  try {
    await deletePhoto(id, options);
    then.gone();
  } catch (error) {
    then.back(error.message);
  } finally {
    waiting.delete(id);
  }
}

function show(id, name) {
  hide();
  const button = element('button', '', t('Undo'));
  button.type = 'button';
  const bar = element('div', 'toast undo on', element('span', '', t('{0} deleted', name)), button);
  bar.setAttribute('role', 'status');
  shown = { id, bar };
  document.body.append(bar);
  button.addEventListener('click', () => {
    const { timer, then } = waiting.get(id);
    clearTimeout(timer);
    waiting.delete(id);
    hide();
    then.back();
  });
}

function hide() {
  shown?.bar.remove();
  shown = null;
}

// whoever leaves the page has not changed their mind
addEventListener('pagehide', () => {
  for (const id of waiting.keys()) run(id, { keepalive: true });
});

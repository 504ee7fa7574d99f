// Deletions with undo: they wait a little, then run together, or are undone together.

import { t } from '../i18n/messages.js';
import { deletePhoto } from './api.js';
import { at, element } from './dom.js';

/** Time to undo, counted from the last deletion. */
const WAIT_MS = 8000;
/** Storage key with which a photo's page tells the list of photos what to delete. */
const HANDED_KEY = 'tmpi:deleted';

/**
 * A photo to delete: its name, and what to do when it is gone, or when it stays and why.
 * @typedef {{id: string, name: string, gone: () => void, back: (reason?: string) => void}} Deletion
 */

/** @type {Map<string, Deletion>} */
const waiting = new Map();
/** Ids of photos that are being deleted on the server. */
const going = new Set();
/** @type {ReturnType<typeof setTimeout> | undefined} */
let timer;
/** @type {HTMLElement | null} */
let bar = null;

/** True while a deletion of the photo is pending. */
export const isGoing = (/** @type {string} */ id) => waiting.has(id) || going.has(id);

/**
 * Deletes photos after a while, unless the user undoes it.
 * @param {Deletion[]} photos
 */
export function deleteLater(photos) {
  for (const photo of photos) waiting.set(photo.id, photo);
  clearTimeout(timer);
  timer = setTimeout(() => run(), WAIT_MS);
  show();
}

/** @param {RequestInit} [options] */
async function run(options) {
  clearTimeout(timer);
  hide();
  const photos = [...waiting.values()];
  waiting.clear();
  for (const { id } of photos) going.add(id);
  await Promise.all(
    photos.map(async ({ id, gone, back }) => {
      try {
        await deletePhoto(id, options);
        gone();
      } catch (error) {
        back(error.message);
      } finally {
        going.delete(id);
      }
    }),
  );
}

function show() {
  hide();
  const button = element('button', '', t('Undo'));
  button.type = 'button';
  const [first] = waiting.values();
  const text = waiting.size === 1 ? t('{0} deleted', first.name) : t('{0} photos deleted', waiting.size);
  bar = element('div', 'toast undo on', element('span', '', text), button);
  bar.setAttribute('role', 'status');
  document.body.append(bar);
  button.addEventListener('click', () => {
    clearTimeout(timer);
    hide();
    const photos = [...waiting.values()];
    waiting.clear();
    for (const { back } of photos) back();
  });
}

function hide() {
  bar?.remove();
  bar = null;
}

// leaving the page does not cancel the deletion
addEventListener('pagehide', () => {
  if (waiting.size) run({ keepalive: true });
});

/**
 * Leaves a photo's page for the list of photos, which deletes it there, with undo.
 * @param {string} id
 * @param {string} name
 */
export function handOver(id, name) {
  try {
    sessionStorage.setItem(HANDED_KEY, JSON.stringify({ id, name }));
    location.assign(at('/'));
  } catch {
    // without storage there is no undo
    deletePhoto(id).then(() => location.assign(at('/')));
  }
}

/**
 * The deletion that the page before handed over; returned once.
 * @returns {{id: string, name: string} | null}
 */
export function handedOver() {
  try {
    const text = sessionStorage.getItem(HANDED_KEY);
    sessionStorage.removeItem(HANDED_KEY);
    return text ? JSON.parse(text) : null;
  } catch {
    return null;
  }
}

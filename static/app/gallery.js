// The list of photos: a card for each, one or many deleted at a time.

import { formatBytes, sentence } from '../i18n/format.js';
import { t } from '../i18n/messages.js';
import { listPhotos, photoUrl } from './api.js';
import { deleteLater, isGoing } from './delete-later.js';
import { $, at, element, icon } from './dom.js';
import { isUnderWay, reasonOf } from './follow-photo.js';
import { photoName } from './photo-name.js';
import { say } from './upload-row.js';

/** @import { Photo } from './api.js' */
/** @import { Deletion } from './delete-later.js' */

/** Aspect ratios of cards, width by height: longer pictures are cropped. */
const NARROWEST = 0.62;
const WIDEST = 2.6;
const USUAL = 1.5;

/** A card: the key of its content, and its deletion. @type {Map<string, {key: string, root: HTMLLIElement, deletion: Deletion}>} */
const cards = new Map();
/** Address of the next page of the list. @type {string | null} */
let next = null;
/** True once more than the first page is shown. */
let paged = false;
let selecting = false;
/** @type {ReturnType<typeof setTimeout> | undefined} */
let asked;
let forget = (/** @type {string} */ _id) => {};

/**
 * Fills the list.
 * @param {(id: string) => void} gone called when a photo was deleted
 */
export async function startGallery(gone) {
  forget = gone;
  const more = $('more', HTMLButtonElement);
  more.addEventListener('click', async () => {
    more.disabled = true;
    paged = true;
    const page = await list(next);
    if (page) show(page, true);
    more.disabled = false;
  });
  $('select').addEventListener('click', () => select(!selecting));
  $('selection-done').addEventListener('click', () => select(false));
  $('selection-all').addEventListener('click', () => {
    const all = boxes();
    const on = all.some((box) => !box.checked);
    for (const box of all) box.checked = on;
    count();
  });
  $('selection-delete').addEventListener('click', () => {
    const ids = chosen();
    select(false);
    remove(ids);
  });
  $('gallery').addEventListener('change', count);
  $('gallery').addEventListener('click', (event) => {
    const link = event.target instanceof Element && event.target.closest('a');
    if (!selecting || !link) return;
    // a click on the picture selects it, like its checkbox
    event.preventDefault();
    link.closest('.card')?.querySelector('input')?.click();
  });
  document.addEventListener('keydown', ({ key }) => {
    if (key === 'Escape' && selecting) select(false);
  });
  return refresh();
}

/** Fetches the list again after a moment: many photos may be ready or gone at a time. */
export function refreshSoon() {
  clearTimeout(asked);
  asked = setTimeout(refresh, 150);
}

async function refresh() {
  const page = await list();
  if (page) show(page, false);
  return page;
}

/** @param {string | null} [address] */
async function list(address) {
  try {
    return await listPhotos(address ?? undefined);
  } catch (error) {
    $('gallery-note').hidden = false;
    $('gallery-note').textContent = sentence(error.message);
    return null;
  }
}

/**
 * @param {{photos: Photo[], next?: string}} page
 * @param {boolean} more
 */
function show(page, more) {
  const gallery = $('gallery');
  /** @type {Element[]} */
  const wanted = page.photos.filter((photo) => !isUnderWay(photo)).map(cardOf);
  // keep cards of further pages
  const last = page.photos.at(-1)?.created ?? '';
  const kept = [...gallery.children].filter(
    (child) => more || (paged && child instanceof HTMLElement && !wanted.includes(child) && (child.dataset.created ?? '') <= last),
  );
  const all = [...new Set(more ? [...kept, ...wanted] : [...wanted, ...kept])];
  for (const child of [...gallery.children]) if (!all.includes(child)) child.remove();
  // moving a card would lose its focus and its viewer
  all.forEach((card, i) => {
    if (gallery.children[i] !== card) gallery.insertBefore(card, gallery.children[i] ?? null);
  });
  if (more || !paged) next = page.next ?? null;
  $('more').hidden = !next;
  $('gallery-note').textContent = t('No photo yet. The first one takes a few seconds.');
  noteEmpty();
}

/** Shows a note if there are no cards. */
function noteEmpty() {
  const seen = [...cards.values()].filter(({ root }) => root.isConnected && !root.hidden).length;
  $('gallery-note').hidden = seen > 0;
  $('select').hidden = seen < 2 && !selecting;
  $('gallery').dispatchEvent(new CustomEvent('shown', { detail: { seen } }));
}

/**
 * The card of a photo, rebuilt only if the photo changed.
 * @param {Photo} photo
 */
function cardOf(photo) {
  const key = JSON.stringify([photo.version, photo.state, photo.settings, photo.links?.poster]);
  const old = cards.get(photo.id);
  if (old?.key === key) {
    old.root.hidden = isGoing(photo.id);
    return old.root;
  }
  const root = photo.state === 'done' ? card(photo) : failedCard(photo);
  root.hidden = isGoing(photo.id);
  cards.set(photo.id, { key, root, deletion: deletionOf(photo, root) });
  if (selecting) mark(root, photoName(photo));
  return root;
}

/** @param {Photo} photo */
function card(photo) {
  const name = photoName(photo);
  const image = element('img', 'thumb');
  image.src = photo.links?.poster ?? photoUrl(photo.id, '/thumbnail');
  image.alt = '';
  image.loading = 'lazy';
  const link = element('a', '', image);
  image.addEventListener('error', () => {
    image.replaceWith(element('span', 'thumb', t('No picture')));
    link.setAttribute('aria-label', `${t('Open {0}', name)} – ${t('No picture')}`);
  });
  link.href = at(`/view/${encodeURIComponent(photo.id)}`);
  link.setAttribute('aria-label', t('Open {0}', name));
  if (photo.links?.atlas) link.dataset.atlas = photo.links.atlas;
  const size = element('span', 'card-size', `${photo.width} × ${photo.height} · `);
  return frame(photo, name, link, element('p', 'card-facts', size, formatBytes(photo.atlas_bytes)));
}

/** @param {Photo} photo */
function failedCard(photo) {
  const thumb = element('span', 'thumb', t('Not made'));
  return frame(photo, photoName(photo), thumb, element('p', 'card-facts bad', sentence(reasonOf(photo))));
}

/**
 * @param {Photo} photo
 * @param {string} name
 * @param {HTMLElement} top
 * @param {HTMLElement} facts
 */
function frame(photo, name, top, facts) {
  const bin = element('button', 'round', icon('bin'));
  bin.type = 'button';
  bin.setAttribute('aria-label', t('Delete {0}', name));
  const text = element('div', 'card-text', element('p', 'card-name', name), facts);
  const root = element('li', 'card', top, element('div', 'card-foot', text, bin));
  root.dataset.id = photo.id;
  root.dataset.created = photo.created;
  const shape = photo.width > 0 && photo.height > 0 ? photo.width / photo.height : USUAL;
  root.style.setProperty('--shape', String(Math.min(WIDEST, Math.max(NARROWEST, shape))));
  bin.addEventListener('click', () => remove([photo.id]));
  return root;
}

/**
 * @param {Photo} photo
 * @param {HTMLElement} root
 * @returns {Deletion}
 */
function deletionOf(photo, root) {
  const name = photoName(photo);
  return {
    id: photo.id,
    name,
    gone: () => {
      cards.delete(photo.id);
      root.remove();
      forget(photo.id);
      say(t('{0} was deleted.', name));
      refreshSoon();
    },
    back: (reason) => {
      root.hidden = false;
      root.querySelector('button')?.focus();
      noteEmpty();
      const facts = root.querySelector('.card-facts');
      if (!reason || !facts) return;
      facts.textContent = sentence(reason);
      facts.classList.add('bad');
      say(reason);
    },
  };
}

/**
 * Deletes photos of the list, with undo.
 * @param {string[]} ids
 */
export function remove(ids) {
  const going = ids.flatMap((id) => cards.get(id) ?? []);
  if (!going.length) return;
  for (const { root } of going) root.hidden = true;
  const last = going[going.length - 1].root;
  const beside = (/** @type {'nextElementSibling' | 'previousElementSibling'} */ way) => {
    let other = last[way];
    while (other instanceof HTMLElement && other.hidden) other = other[way];
    return other;
  };
  const neighbour = beside('nextElementSibling') ?? beside('previousElementSibling');
  (neighbour?.querySelector(/** @type {'a'} */ ('a, button')) ?? $('picker')).focus();
  deleteLater(going.map(({ deletion }) => deletion));
  noteEmpty();
}

// ---- selection

const boxes = () =>
  [...$('gallery').querySelectorAll(/** @type {'input'} */ ('.card > input'))].filter((box) => !box.parentElement?.hidden);
const chosen = () => boxes().flatMap((box) => (box.checked && box.parentElement?.dataset.id) || []);

/** @param {boolean} on */
function select(on) {
  selecting = on;
  $('gallery').classList.toggle('selecting', on);
  $('select').setAttribute('aria-pressed', String(on));
  $('selection').hidden = !on;
  for (const { root, deletion } of cards.values()) {
    if (on) mark(root, deletion.name);
    else root.querySelector(':scope > input')?.remove();
  }
  count();
}

/**
 * @param {HTMLElement} root
 * @param {string} name
 */
function mark(root, name) {
  const box = element('input');
  box.type = 'checkbox';
  box.setAttribute('aria-label', t('Choose {0}', name));
  root.append(box);
}

/** Shows how many are selected. */
function count() {
  const all = boxes();
  const n = chosen().length;
  $('selection-count').textContent = n === 0 ? t('Choose photos to delete') : t('{0} of {1} chosen', n, all.length);
  $('selection-delete', HTMLButtonElement).disabled = n === 0;
}

// Cards that move: the one under the pointer follows it; otherwise one moves without input – the first, or on touch screens the one in the
// middle of the screen. At most one moves, with a small container, and none if the user prefers reduced motion or reduced data.

import { at } from './dom.js';

/** Longer side of a card's container, pixels. */
const FIT = 480;
/** How long a pointer rests on a card, or the page rests after a scroll, before the card moves, ms. */
const HOVER_MS = 120;
const REST_MS = 700;
const FIRST_MS = 1200;

/** @typedef {HTMLElement & {viewer: import('../view/viewer.js').Viewer | null}} Moving */

/** @type {{card: Element, viewer: Moving} | null} */
let now = null;
/** @type {ReturnType<typeof setTimeout> | undefined} */
let timer;
let off = false;

/**
 * Lets cards of a list move. If that fails, they stay pictures.
 * @param {HTMLElement} list of elements `.card` with a link that names its container
 */
export function enliven(list) {
  const still = matchMedia('(prefers-reduced-motion: reduce)');
  const sparing = /** @type {any} */ (navigator).connection?.saveData;
  if (still.matches || sparing) return;
  const later = (/** @type {() => Element | null | undefined} */ which, /** @type {number} */ ms) => {
    clearTimeout(timer);
    timer = setTimeout(() => move(still.matches ? null : (which() ?? null)), ms);
  };
  list.addEventListener('pointerover', (event) => {
    const card = event.target instanceof Element ? event.target.closest('.card') : null;
    if (event.pointerType !== 'mouse' || !card) return;
    if (now?.card === card) clearTimeout(timer);
    else later(() => card, HOVER_MS);
  });
  list.addEventListener('pointermove', (event) => {
    if (event.pointerType !== 'mouse' || !now?.viewer.viewer || !(event.target instanceof Node) || !now.card.contains(event.target)) return;
    const box = now.viewer.getBoundingClientRect();
    // as on the photo's own page, near things follow the pointer
    now.viewer.viewer.motion.aim(1 - ((event.clientX - box.x) / box.width) * 2, 1 - ((event.clientY - box.y) / box.height) * 2);
  });
  list.addEventListener('pointerleave', (event) => {
    if (event.pointerType === 'mouse') later(() => null, REST_MS);
  });
  const touch = matchMedia('(hover: none)');
  if (touch.matches) addEventListener('scroll', () => later(() => middle(list), REST_MS), { passive: true });
  list.addEventListener('shown', () => !now && later(() => (touch.matches ? middle(list) : first(list)), FIRST_MS));
}

/** @param {HTMLElement} list */
const able = (list) => [...list.querySelectorAll('.card:not([hidden]):has(a[data-atlas])')].filter(inSight);

/** @param {Element} card */
function inSight(card) {
  const { top, bottom } = card.getBoundingClientRect();
  return bottom - 60 > 0 && top + 60 < innerHeight;
}

/** @param {HTMLElement} list */
const first = (list) => able(list)[0];

/**
 * The card nearest to the middle of the screen.
 * @param {HTMLElement} list
 */
function middle(list) {
  const distance = (/** @type {Element} */ card) => {
    const { top, height } = card.getBoundingClientRect();
    return Math.abs(top + height / 2 - innerHeight / 2);
  };
  return able(list).sort((a, b) => distance(a) - distance(b))[0];
}

function rest() {
  now?.viewer.remove();
  now = null;
}

/** @param {Element | null} card */
async function move(card) {
  if (off || card === now?.card) return;
  rest();
  const link = card?.querySelector('a');
  const atlas = link?.dataset.atlas;
  if (!card || !link || !atlas || link.closest('.selecting')) return;
  await import(new URL(at('/tmpi-viewer.js'), location.href).href);
  const address = new URL(atlas, location.href);
  address.searchParams.set('fit', String(FIT));
  const viewer = /** @type {Moving} */ (document.createElement('tmpi-viewer'));
  const given = { src: address.href, fit: 'cover', loading: 'eager', 'camera-controls': 'off', fullscreen: 'off', 'aria-hidden': 'true' };
  for (const [name, value] of Object.entries(given)) viewer.setAttribute(name, value);
  viewer.inert = true;
  viewer.addEventListener('load', (event) => {
    // fetching a picture from the server for each view would cost too much here
    off = !(/** @type {CustomEvent} */ (event).detail.mode.match(/^(gpu|webgl)$/));
    if (off) viewer.remove();
    else viewer.classList.add('on');
  });
  viewer.addEventListener('error', () => viewer.remove());
  // the pointer may be on another card by now
  rest();
  now = { card, viewer };
  link.append(viewer);
}

// The photo alone, for frames of other sites: it shows and moves, and nothing in it changes anything on the server.
import { $ } from './dom.js';

const id = location.pathname.split('/').pop();
const photo = `/v1/photos/${id}`;
const viewer = $('viewer');
const failure = $('failure');

viewer.addEventListener('error', (/** @type {Event} */ event) => {
  failure.textContent = /** @type {CustomEvent<{message: string}>} */ (event).detail.message;
  failure.hidden = false;
});
viewer.addEventListener('load', () => {
  failure.hidden = true;
});
viewer.setAttribute('poster', `${photo}/thumbnail`);
viewer.setAttribute('src', `${photo}/atlas`);

const answer = await fetch(`${photo}/settings`).catch(() => null);
const { title } = answer?.ok ? await answer.json() : {};
if (title) {
  document.title = title;
  viewer.setAttribute('alt', title);
}

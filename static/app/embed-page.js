// The photo alone, for frames on other sites: nothing in it changes anything on the server.
import { linkOf, withLink } from '../element/signed-link.js';
import { $, at } from './dom.js';

const id = location.pathname.split('/').pop();
const link = linkOf(location.search);
const photo = (/** @type {string} */ part) => withLink(at(`/v1/photos/${id}/${part}`), link);
const viewer = $('viewer');

// attributes of the element, from the frame's address
const asked = new URLSearchParams(location.search);
for (const name of ['fit', 'auto-rotate', 'camera-controls', 'fullscreen']) {
  const value = asked.get(name);
  if (value !== null) viewer.setAttribute(name, value);
}
viewer.setAttribute('poster', photo('thumbnail'));
viewer.setAttribute('src', photo('atlas'));

const answer = await fetch(photo('settings')).catch(() => null);
const { title } = answer?.ok ? await answer.json() : {};
if (title) {
  document.title = title;
  viewer.setAttribute('alt', title);
}

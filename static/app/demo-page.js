// The element's demo page: three of the server's photos, one of them as if from another server.

import { t, translatePage } from '../i18n/messages.js';
import { listPhotos } from './api.js';
import { $, at } from './dom.js';
import { photoName } from './photo-name.js';

const SHOWN = 3;

/** The same server under a host name that makes it another origin; the page's own origin if there is no such name. */
function otherOrigin() {
  const url = new URL(location.origin);
  if (url.hostname === '127.0.0.1') url.hostname = 'localhost';
  else if (url.hostname === 'localhost') url.hostname = '127.0.0.1';
  return url.origin;
}

async function show() {
  const { photos } = await listPhotos();
  const done = photos.filter((photo) => photo.state === 'done').slice(0, SHOWN);
  if (!done.length) {
    $('demo-note').textContent = t('No photo yet. The first one takes a few seconds.');
    return;
  }
  $('demo-note').hidden = true;
  const figures = [...document.querySelectorAll('figure')];
  figures.forEach((figure, i) => {
    // with fewer photos, one appears again
    const photo = done[i % done.length];
    const element = figure.querySelector('tmpi-viewer');
    if (!(element instanceof HTMLElement)) return;
    element.style.aspectRatio = `${photo.width} / ${photo.height}`;
    element.setAttribute('alt', photoName(photo));
    element.setAttribute('poster', photo.links.poster);
    element.setAttribute('src', (i === figures.length - 1 ? otherOrigin() : '') + photo.links.atlas);
    figure.hidden = false;
  });
  $('demo-origin').textContent = otherOrigin();
  const src = location.origin + done[0].links.atlas;
  $('demo-code').textContent =
    `<script type="module" src="${location.origin}${at('/tmpi-viewer.js')}"></script>\n<tmpi-viewer src="${src}"\n  alt="${t('What it shows')}"></tmpi-viewer>`;
}

translatePage();
show().catch((error) => ($('demo-note').textContent = error.message));

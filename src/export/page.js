// Entry module of a self-contained page.
import { Viewer } from './view/viewer.js';

const $ = (id) => document.getElementById(id);
const stage = $('stage');

function bytesOf(base64) {
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

/** The container as a data URL: a worker of a page from disk can fetch nothing else. */
function container() {
  const photo = $('photo').getAttribute('src');
  const pieces = [$('before').textContent, photo.slice(photo.indexOf(',') + 1), $('after').textContent];
  return new Promise((resolve, reject) => {
    const reader = new FileReader();
    reader.onload = () => resolve(reader.result);
    reader.onerror = () => reject(reader.error);
    reader.readAsDataURL(new Blob(pieces.map(bytesOf), { type: 'application/vnd.tmpi' }));
  });
}

function note(text) {
  $('note').textContent = text;
}

async function show() {
  const viewer = new Viewer(stage, { atlas: await container() });
  // for tests and the developer console
  window.viewer = viewer;
  // from now on the viewer shows the photo, at the scene's size
  viewer.addEventListener('photo', () => ($('photo').hidden = true));
  viewer.addEventListener('ready', ({ detail }) => (stage.dataset.mode = detail.mode));
  viewer.addEventListener('mode', ({ detail }) => {
    stage.dataset.mode = detail.mode;
    note(detail.mode === 'still' ? `This browser shows the photo alone. ${detail.reason}` : '');
  });
  viewer.addEventListener('error', ({ detail }) => note(detail.message));
}

show().catch((error) => note(error.message));

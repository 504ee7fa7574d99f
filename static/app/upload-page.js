// The page of all photos: uploads new ones, shows their progress, and lists the finished ones.

import { translatePage } from '../i18n/messages.js';
import { deletePhoto, getPresets } from './api.js';
import { enliven } from './card-motion.js';
import { deleteLater, handedOver } from './delete-later.js';
import { pairs } from './depth-pairs.js';
import { $, at } from './dom.js';
import { filesOf } from './drop.js';
import { isUnderWay } from './follow-photo.js';
import { refreshSoon, remove, startGallery } from './gallery.js';
import { takeShared } from './installed.js';
import { photoName } from './photo-name.js';
import { freshName, publishPage } from './room-name.js';
import { forgetRow, resume, startUploads, upload } from './uploads.js';

/** @import { Found } from './depth-pairs.js' */

/**
 * Options for each choice of quality; the server's defaults apply to the rest.
 * @type {Record<string, Record<string, number>>}
 */
const QUALITIES = {
  small: { quality: 75, 'max-error': 4 },
  good: {},
  best: { quality: 97, 'max-error': 0.5 },
};

const [map, eye] = ['depth-map', 'second-eye'].map((id) => $(id, HTMLInputElement));
// depth comes from one of them
map.addEventListener('change', () => {
  eye.value = '';
});
eye.addEventListener('change', () => {
  map.value = '';
});

const preset = $('preset', HTMLSelectElement);

/** Offers the presets of photos, and the quality where neither a preset nor the server rules it out. */
async function offerPresets() {
  const { presets, only } = await getPresets();
  const names = presets.filter(({ kind }) => kind === 'photo').map(({ name }) => name);
  preset.append(...names.map((name) => new Option(name)));
  $('preset-option').hidden = !names.length;
  const offerQuality = () => {
    $('quality-option').hidden = only || preset.value !== '';
  };
  preset.addEventListener('change', offerQuality);
  offerQuality();
}

/**
 * Options of the next photos.
 * @returns {Record<string, string | number>}
 */
function options() {
  if (preset.value) return { preset: preset.value };
  return $('quality-option').hidden ? {} : QUALITIES[$('quality', HTMLSelectElement).value];
}

/** @param {Found[]} found */
function take(found) {
  const photos = pairs(found);
  // a depth map or second eye that the user chose belongs to a single photo
  const [ownMap, second] = [map, eye].map(({ files }) => (photos.length === 1 ? files?.[0] : undefined));
  if (ownMap || second) {
    photos[0] = { ...photos[0], depth: ownMap ?? null, second };
    map.value = '';
    eye.value = '';
  }
  upload(photos, options());
}

for (const picker of [$('picker', HTMLInputElement), $('camera', HTMLInputElement)]) {
  picker.addEventListener('change', () => {
    take([...(picker.files ?? [])].map((file) => ({ file })));
    picker.value = '';
  });
}
// if HEIC is not accepted, phones send a JPEG of their own
if (!matchMedia('(pointer: coarse)').matches) $('picker', HTMLInputElement).accept += ',.heic,.heif';

let depth = 0;
const carriesFiles = (/** @type {DragEvent} */ event) => event.dataTransfer?.types.includes('Files');
addEventListener('dragenter', (event) => {
  if (!carriesFiles(event)) return;
  depth++;
  $('drop').classList.add('over');
});
addEventListener('dragleave', (event) => {
  if (!carriesFiles(event)) return;
  depth = Math.max(0, depth - 1);
  if (!depth) $('drop').classList.remove('over');
});
addEventListener('dragover', (event) => carriesFiles(event) && event.preventDefault());
addEventListener('drop', async (event) => {
  if (!carriesFiles(event)) return;
  event.preventDefault();
  depth = 0;
  $('drop').classList.remove('over');
  if (event.dataTransfer) take(await filesOf(event.dataTransfer));
});
addEventListener('paste', (event) => {
  const found = [...(event.clipboardData?.files ?? [])].map((file) => ({ file }));
  if (!found.length) return;
  event.preventDefault();
  take(found);
});

/** Shows a sample if there are no photos yet. */
async function showSample() {
  const place = $('sample');
  if (!place.hidden) return;
  place.hidden = false;
  await import(new URL(at('/tmpi-viewer.js'), location.href).href);
}

translatePage();
offerPresets();
$('go-live', HTMLAnchorElement).href = publishPage(freshName());
enliven($('gallery'));
$('gallery').addEventListener('shown', (event) => {
  if (/** @type {CustomEvent} */ (event).detail.seen) $('sample').hidden = true;
  else showSample();
});
startUploads({
  made: refreshSoon,
  remove: async (id) => {
    await deletePhoto(id);
    forgetRow(id);
  },
});
takeShared().then((files) => files.length && take(files.map((file) => ({ file }))));
const deleted = handedOver();
startGallery(forgetRow).then((page) => {
  for (const photo of page?.photos ?? []) if (isUnderWay(photo)) resume(photo, photoName(photo));
  if (!deleted) return;
  if (page?.photos.some(({ id }) => id === deleted.id)) return remove([deleted.id]);
  // it is on a further page of the list
  deleteLater([{ ...deleted, gone: () => forgetRow(deleted.id), back: () => {} }]);
});

// The page of all photos: takes new ones, shows how far they are, and lists those that are there.

import { t, translatePage } from '../i18n/messages.js';
import { formatBytes, queueText, sentence, stageText } from '../i18n/text.js';
import { deletePhoto, listPhotos, photoUrl, uploadPhoto } from './api.js';
import { $, element, icon } from './dom.js';
import { filesOf } from './drop.js';
import { followPhoto, isUnderWay, reasonOf } from './follow-photo.js';
import { pairs } from './pairs.js';
import { forgetName, photoName } from './photo-name.js';
import { deleteLater, isGoing } from './undo.js';
import { Row, say } from './upload-row.js';

/** @import { Photo } from './api.js' */

/** Uploads under way at the same time. */
const PARALLEL = 2;
/** Share of the bar that the upload itself takes. */
const UPLOAD_SHARE = 0.25;
/**
 * What the words for quality mean: options of the interface; what is not named stays as the server has it.
 * @type {Record<string, Record<string, number>>}
 */
const QUALITIES = {
  small: { quality: 75, 'max-error': 1.15 },
  good: {},
  best: { quality: 97, 'max-error': 0.25 },
};

/** @type {{file: File, depth: File | null, options: Record<string, number>, row: Row}[]} */
const waiting = [];
/** Rows by the ids of their photos. */
const rows = new Map();
let running = 0;

// ---- uploads

/** @param {File[]} files */
function take(files) {
  const map = $('depth-map', HTMLInputElement);
  const photos = pairs(files);
  // a map that was chosen belongs to one photo
  const chosen = photos.length === 1 ? map.files?.[0] : undefined;
  if (chosen) {
    photos[0].depth = chosen;
    map.value = '';
  }
  const options = QUALITIES[$('quality', HTMLSelectElement).value];
  for (const { file, depth } of photos) {
    const row = new Row(file.name || t('Pasted photo'), file);
    row.show(t('Waiting to be sent'));
    const job = { file, depth, options, row };
    row.onClose = () => {
      waiting.splice(waiting.indexOf(job), 1);
      row.remove();
    };
    waiting.push(job);
  }
  sendNext();
}

function sendNext() {
  while (running < PARALLEL && waiting.length) {
    running++;
    const [job] = waiting.splice(0, 1);
    send(job).finally(() => {
      running--;
      sendNext();
    });
  }
}

/** @param {typeof waiting[number]} job */
async function send({ file, depth, options, row }) {
  try {
    const photo = await post(file, depth, options, row);
    // making it goes on without holding up the next upload
    follow(photo, row);
  } catch (error) {
    if (error.name === 'AbortError') row.remove();
    else row.fail(error.message);
  }
}

/**
 * Sends the file; where the server is busy, waits as long as it asks.
 * @param {File} file
 * @param {File | null} depth
 * @param {Record<string, number>} options
 * @param {Row} row
 */
async function post(file, depth, options, row) {
  for (;;) {
    const upload = uploadPhoto(file, depth, options, (share) =>
      row.show(share < 1 ? t('Sending, {0} %', Math.round(share * 100)) : t('Sent'), share * UPLOAD_SHARE),
    );
    row.onClose = upload.abort;
    try {
      return await upload.done;
    } catch (error) {
      if (!error.retryAfter) throw error;
      row.show(t('The server is busy; trying again in {0} s', error.retryAfter), 0);
      await pause(error.retryAfter * 1000, row);
    }
  }
}

/**
 * @param {number} ms
 * @param {Row} row
 */
function pause(ms, row) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, ms);
    row.onClose = () => {
      clearTimeout(timer);
      reject(new DOMException('Cancelled.', 'AbortError'));
    };
  });
}

/**
 * @param {Photo} photo
 * @param {Row} row
 */
function follow(photo, row) {
  rows.set(photo.id, row);
  const stop = followPhoto(photo.id, {
    queued: (position) => row.show(queueText(position), UPLOAD_SHARE),
    stage: ({ stage, step, steps }) => row.show(stageText(stage), UPLOAD_SHARE + (1 - UPLOAD_SHARE) * (steps ? (step - 1) / steps : 0)),
    done: () => {
      row.done(photo.id);
      refresh();
    },
    failed: (message) => row.fail(message),
    deleted: () => row.remove(),
  });
  row.onClose = async () => {
    stop();
    try {
      await remove(photo.id);
    } catch (error) {
      row.fail(error.message);
    }
  };
}

// ---- gallery

/** @param {string} id */
async function remove(id) {
  await deletePhoto(id);
  forget(id);
}

/** @param {string} id */
function forget(id) {
  forgetName(id);
  rows.get(id)?.remove();
  rows.delete(id);
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
  link.href = `/view/${encodeURIComponent(photo.id)}`;
  link.setAttribute('aria-label', t('Open {0}', name));
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
  bin.addEventListener('click', () => {
    const next = root.nextElementSibling ?? root.previousElementSibling;
    root.hidden = true;
    (next?.querySelector(/** @type {'a'} */ ('a, button')) ?? $('picker')).focus();
    deleteLater(photo.id, name, {
      gone: () => {
        forget(photo.id);
        root.remove();
        say(t('{0} was deleted.', name));
        refresh();
      },
      back: (reason) => {
        root.hidden = false;
        bin.focus();
        if (!reason) return;
        facts.textContent = sentence(reason);
        facts.classList.add('bad');
        say(reason);
      },
    });
  });
  return root;
}

/**
 * Address of the next page of the list.
 * @type {string | null}
 */
let next = null;

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
  const cards = page.photos
    .filter((photo) => !isUnderWay(photo) && !isGoing(photo.id))
    .map((photo) => (photo.state === 'done' ? card(photo) : failedCard(photo)));
  if (more) $('gallery').append(...cards);
  else $('gallery').replaceChildren(...cards);
  $('gallery-note').hidden = $('gallery').children.length > 0;
  $('gallery-note').textContent = t('No photo yet. The first one takes a few seconds.');
  next = page.next ?? null;
  $('more').hidden = !next;
}

async function refresh() {
  const page = await list();
  if (page) show(page, false);
  return page;
}

/**
 * Photos that were on their way when the page was opened.
 * @param {Photo[]} photos
 */
function resume(photos) {
  for (const photo of photos) {
    if (!isUnderWay(photo) || rows.has(photo.id)) continue;
    follow(photo, new Row(photoName(photo), null));
  }
}

const more = $('more', HTMLButtonElement);
more.addEventListener('click', async () => {
  more.disabled = true;
  const page = await list(next);
  if (page) show(page, true);
  more.disabled = false;
});

// ---- picker, camera, drop, paste

for (const picker of [$('picker', HTMLInputElement), $('camera', HTMLInputElement)]) {
  picker.addEventListener('change', () => {
    take([...(picker.files ?? [])]);
    picker.value = '';
  });
}

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
  const files = [...(event.clipboardData?.files ?? [])];
  if (!files.length) return;
  event.preventDefault();
  take(files);
});

translatePage();
refresh().then((page) => page && resume(page.photos));

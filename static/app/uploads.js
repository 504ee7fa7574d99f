// Photos being uploaded or made: a few at a time, active ones first, and their overall progress.

import { queueText, stageText } from '../i18n/format.js';
import { t } from '../i18n/messages.js';
import { prepared } from './convert.js';
import { $, at, element } from './dom.js';
import { followPhoto } from './follow-photo.js';
import { mayAsk, notify } from './installed.js';
import { uploadPhoto } from './upload-photo.js';
import { Row } from './upload-row.js';

/** @import { Photo } from './api.js' */

/** Number of parallel uploads. */
const PARALLEL = 2;
/** Maximum number of photos whose events are followed at a time: browsers allow six connections for the whole page. */
const FOLLOWED = 3;
/** Maximum number of visible rows; the others are counted. */
const SEEN = 3;
/** How long the last finished row stays, ms. */
const FOLD_MS = 12_000;
/** Share of the bar that the upload itself takes. */
const UPLOAD_SHARE = 0.25;

/** What tells the depth of a photo, if not the photo itself. @typedef {{depth: File | null, second?: File}} Beside */
/** @typedef {{file: File, beside: Beside, options: Record<string, string | number>, row: Row}} Job */

/** Files that wait to be sent. @type {Job[]} */
const waiting = [];
/** Uploaded photos whose events are not followed yet. @type {{photo: Photo, row: Row}[]} */
const made = [];
/** All rows, in their order. @type {Set<Row>} */
const rows = new Set();
/** Rows by the ids of their photos. @type {Map<string, Row>} */
const byId = new Map();
let sending = 0;
let following = 0;
/** Rows that became ready since the page was last idle. */
let ready = 0;
/** @type {ReturnType<typeof setTimeout> | undefined} */
let folding;
const pageTitle = document.title;

/**
 * What the page does when a photo is ready, and how it deletes one.
 * @type {{made: () => void, remove: (id: string) => Promise<void>}}
 */
let page = { made: () => {}, remove: async () => {} };

/** @param {typeof page} own */
export function startUploads(own) {
  page = own;
  $('uploads-cancel').addEventListener('click', () => {
    for (const row of [...rows].reverse()) if (row.kind === 'open') row.onClose?.();
  });
  $('uploads-notify').addEventListener('click', async () => {
    await Notification.requestPermission();
    arrangeSoon();
  });
  $('uploads-dismiss').addEventListener('click', () => {
    for (const row of rows) if (row.kind === 'failed') row.remove();
  });
}

addEventListener('beforeunload', (event) => {
  // uploads that are sent finish without the page
  if (sending || waiting.length) event.preventDefault();
});

/**
 * Uploads photos.
 * @param {({file: File} & Beside)[]} photos
 * @param {Record<string, string | number>} options of the interface
 */
export function upload(photos, options) {
  for (const { file, ...beside } of photos) {
    const row = rowOf(file.name || t('Pasted photo'), file);
    const job = { file, beside, options, row };
    row.onClose = () => {
      waiting.splice(waiting.indexOf(job), 1);
      row.remove();
    };
    row.show(t('Waiting to be sent'));
    waiting.push(job);
  }
  sendNext();
}

/**
 * Shows a photo that was in work when the page was opened.
 * @param {Photo} photo
 * @param {string} name
 */
export function resume(photo, name) {
  if (!byId.has(photo.id)) follow(photo, rowOf(name, null));
}

/**
 * Removes the row of a deleted photo.
 * @param {string} id
 */
export function forgetRow(id) {
  byId.get(id)?.remove();
  byId.delete(id);
}

/**
 * @param {string} name
 * @param {File | null} file
 */
function rowOf(name, file) {
  if (![...rows].some((row) => row.kind === 'open')) ready = 0;
  const row = new Row(name, file, arrangeSoon);
  rows.add(row);
  return row;
}

function sendNext() {
  while (sending < PARALLEL && waiting.length) {
    sending++;
    const [job] = waiting.splice(0, 1);
    send(job).finally(() => {
      sending--;
      sendNext();
    });
  }
}

/** @param {Job} job */
async function send({ file, beside, options, row }) {
  try {
    let cancelled = false;
    row.onClose = () => {
      cancelled = true;
      row.remove();
    };
    const photo = await prepared(file, (loss) => {
      // a depth map or second eye beside the photo replaces the photo's own
      if (!beside.depth && !beside.second) row.note = loss;
      row.show(t('Converting'));
    });
    // making it does not hold up the next upload
    if (!cancelled) follow(await post(photo, beside, options, row), row);
  } catch (error) {
    if (error.name === 'AbortError') row.remove();
    else row.fail(error.message);
  }
}

/**
 * Uploads the file; if the server is busy, waits as long as it asks for.
 * @param {File} file
 * @param {Beside} beside
 * @param {Record<string, string | number>} options
 * @param {Row} row
 */
async function post(file, beside, options, row) {
  for (;;) {
    const going = uploadPhoto(file, beside, options, (share) => row.show(sendingText(share), share * UPLOAD_SHARE));
    row.onClose = going.abort;
    try {
      return await going.done;
    } catch (error) {
      if (!error.retryAfter) throw error;
      row.show(t('The server is busy; trying again in {0} s', error.retryAfter), 0);
      await pause(error.retryAfter * 1000, row);
    }
  }
}

/** @param {number} share */
function sendingText(share) {
  return share < 1 ? t('Sending, {0} %', Math.floor(share * 100)) : t('Sent');
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
  byId.set(photo.id, row);
  const entry = { photo, row };
  row.show(queueText(0), UPLOAD_SHARE);
  row.onClose = () => {
    if (made.includes(entry)) made.splice(made.indexOf(entry), 1);
    remove(photo.id, row);
  };
  made.push(entry);
  followNext();
}

function followNext() {
  while (following < FOLLOWED && made.length) {
    const [{ photo, row }] = made.splice(0, 1);
    following++;
    const then = (/** @type {() => void} */ call) => () => {
      following--;
      call();
      followNext();
    };
    const stop = followPhoto(photo.id, {
      queued: (position) => row.show(queueText(position), UPLOAD_SHARE),
      stage: ({ stage, step, steps }) => row.show(stageText(stage), UPLOAD_SHARE + (1 - UPLOAD_SHARE) * (steps ? (step - 1) / steps : 0)),
      done: then(() => {
        ready++;
        row.done(photo.id);
        page.made();
        tell(row.name, photo.id);
      }),
      failed: (message) => then(() => row.fail(message))(),
      deleted: then(() => row.remove()),
    });
    row.onClose = then(() => {
      stop();
      remove(photo.id, row);
    });
  }
}

/** Number of photos that are ready or under way, since none was. */
function allOf() {
  return ready + [...rows].filter((row) => row.kind === 'open').length;
}

/**
 * Tells the user that a photo is ready.
 * @param {string} name
 * @param {string} id
 */
function tell(name, id) {
  const all = allOf();
  if (all > 1) notify(t('{0} of {1} ready', ready, all), at('/'));
  else notify(t('{0} is ready.', name), at(`/view/${encodeURIComponent(id)}`));
}

/**
 * @param {string} id
 * @param {Row} row
 */
async function remove(id, row) {
  try {
    await page.remove(id);
    row.remove();
  } catch (error) {
    row.fail(error.message);
  }
}

let arranging = false;

/** Arranges the rows once for several changes. */
function arrangeSoon() {
  if (arranging) return;
  arranging = true;
  queueMicrotask(() => {
    arranging = false;
    arrange();
  });
}

/** Updates the visible rows and the overall progress. */
function arrange() {
  for (const row of rows) if (!row.root.isConnected) rows.delete(row);
  const of = (/** @type {Row['kind']} */ kind) => [...rows].filter((row) => row.kind === kind);
  const [open, done, failed] = [of('open'), of('done'), of('failed')];
  // the newest finished row stays a while, so that the user sees it finish
  for (const row of done.slice(0, -1)) if (!row.attended) row.remove();
  clearTimeout(folding);
  if (done.length) folding = setTimeout(fold, FOLD_MS);
  open.forEach((row, i) => (row.shown = i < SEEN));
  for (const row of [...done, ...failed]) row.shown = true;
  const all = allOf();
  const more = Math.max(0, open.length - SEEN);
  const share = all ? (ready + open.reduce((sum, row) => sum + row.share, 0)) / all : 0;
  $('uploads').hidden = rows.size === 0;
  $('uploads-bar', HTMLProgressElement).value = share;
  $('uploads-bar').hidden = all < 2 || !open.length;
  $('uploads-total').replaceChildren(
    ...(all > 1 ? [t('{0} of {1} ready', ready, all)] : []),
    ...(failed.length > 1 ? [element('span', 'bad', t('{0} failed', failed.length))] : []),
  );
  $('uploads-more').hidden = !more;
  $('uploads-more-text').textContent = t('and {0} more', more);
  $('uploads-notify').hidden = !open.length || !mayAsk();
  $('uploads-dismiss').hidden = failed.length < 2;
  document.title = open.length && all > 1 ? `${t('{0} of {1}', ready, all)} – tmpi` : pageTitle;
}

/** Removes the last finished row, unless it has the pointer or the focus. */
function fold() {
  for (const row of rows) {
    if (row.kind !== 'done') continue;
    if (row.attended) folding = setTimeout(fold, FOLD_MS);
    else row.remove();
  }
}

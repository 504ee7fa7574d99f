// The page of all photos: takes new ones, shows how far they are, and lists those that are there.
import { deletePhoto, listPhotos, photoUrl, uploadPhoto } from './api.js';
import { followPhoto, isUnderWay, reasonOf } from './events.js';
import { element, forgetName, formatBytes, icon, photoName, queueText, rememberName, sentence, stageText } from './text.js';

/** Uploads under way at the same time. */
const PARALLEL = 2;
/** Share of the bar that the upload itself takes. */
const UPLOAD_SHARE = 0.25;

const $ = (id) => document.getElementById(id);
const waiting = [];
/** Rows by the ids of their photos. */
const rows = new Map();
let running = 0;

function say(text) {
  $('status').textContent = text;
}

// ---- one row while a photo is on its way

class Row {
  constructor(name, preview) {
    this.name = name;
    this.preview = preview && URL.createObjectURL(preview);
    this.state = element('p', 'upload-state');
    this.bar = element('progress');
    this.bar.max = 1;
    this.bar.value = 0;
    this.bar.setAttribute('aria-label', `Progress of ${name}`);
    this.close = element('button', 'round', icon('close'));
    this.close.type = 'button';
    this.close.setAttribute('aria-label', `Cancel ${name}`);
    this.close.addEventListener('click', () => this.onClose?.());
    this.actions = element('div', 'upload-actions', this.close);
    const body = element('div', 'upload-body', element('p', 'upload-name', name), this.bar, this.state);
    this.root = element('li', 'upload', previewOf(this.preview), body, this.actions);
    $('upload-list').prepend(this.root);
    $('uploads').hidden = false;
  }

  show(text, share) {
    this.state.textContent = text;
    if (share !== undefined) this.bar.value = share;
  }

  fail(message) {
    this.root.classList.add('failed');
    this.bar.hidden = true;
    this.state.textContent = sentence(message);
    this.close.setAttribute('aria-label', `Dismiss ${this.name}`);
    this.onClose = () => this.remove();
    say(`${this.name}: ${message}`);
  }

  done(id) {
    this.bar.hidden = true;
    this.state.textContent = 'Ready';
    const open = element('a', 'button primary', 'Open');
    open.href = `/view/${encodeURIComponent(id)}`;
    open.setAttribute('aria-label', `Open ${this.name}`);
    this.actions.replaceChildren(open);
    say(`${this.name} is ready.`);
  }

  remove() {
    this.root.remove();
    if (this.preview) URL.revokeObjectURL(this.preview);
    $('uploads').hidden = !$('upload-list').children.length;
  }
}

/** A small picture, or an empty frame where there is none to show. */
function previewOf(address) {
  const empty = element('span', 'upload-picture');
  if (!address) return empty;
  const image = element('img', 'upload-picture');
  image.alt = '';
  image.addEventListener('error', () => image.replaceWith(empty));
  image.src = address;
  return image;
}

// ---- uploads

function take(files) {
  for (const file of files) {
    const row = new Row(file.name || 'Pasted photo', file);
    row.show('Waiting to be sent');
    const job = { file, row };
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
    send(waiting.shift()).finally(() => {
      running--;
      sendNext();
    });
  }
}

async function send({ file, row }) {
  try {
    const photo = await post(file, row);
    rememberName(photo.id, row.name);
    // making it goes on without holding up the next upload
    follow(photo, row);
  } catch (error) {
    if (error.name === 'AbortError') row.remove();
    else row.fail(error.message);
  }
}

/** Sends the file; where the server is busy, waits as long as it asks. */
async function post(file, row) {
  for (;;) {
    const upload = uploadPhoto(file, (share) => row.show(share < 1 ? `Sending, ${Math.round(share * 100)} %` : 'Sent', share * UPLOAD_SHARE));
    row.onClose = upload.abort;
    try {
      return await upload.done;
    } catch (error) {
      if (!error.retryAfter) throw error;
      row.show(`The server is busy; trying again in ${error.retryAfter} s`, 0);
      await pause(error.retryAfter * 1000, row);
    }
  }
}

function pause(ms, row) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, ms);
    row.onClose = () => {
      clearTimeout(timer);
      reject(new DOMException('Cancelled.', 'AbortError'));
    };
  });
}

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

async function remove(id) {
  await deletePhoto(id);
  forgetName(id);
  rows.get(id)?.remove();
  rows.delete(id);
}

function card(photo) {
  const name = photoName(photo);
  const image = element('img', 'thumb');
  image.src = photoUrl(photo.id, '/thumbnail');
  image.alt = '';
  image.loading = 'lazy';
  image.addEventListener('error', () => image.replaceWith(element('span', 'thumb', 'No picture')));
  const link = element('a', '', image);
  link.href = `/view/${encodeURIComponent(photo.id)}`;
  link.setAttribute('aria-label', `Open ${name}`);
  const size = element('span', 'card-size', `${photo.width} × ${photo.height} · `);
  return frame(photo, name, link, element('p', 'card-facts', size, formatBytes(photo.atlas_bytes)));
}

function failedCard(photo) {
  const thumb = element('span', 'thumb', 'Not made');
  return frame(photo, photoName(photo), thumb, element('p', 'card-facts bad', sentence(reasonOf(photo))));
}

function frame(photo, name, top, facts) {
  const bin = element('button', 'round', icon('bin'));
  bin.type = 'button';
  bin.setAttribute('aria-label', `Delete ${name}`);
  const text = element('div', 'card-text', element('p', 'card-name', name), facts);
  const root = element('li', 'card', top, element('div', 'card-foot', text, bin));
  bin.addEventListener('click', async () => {
    if (!confirm(`Delete ${name}? This cannot be undone.`)) return;
    bin.disabled = true;
    try {
      await remove(photo.id);
      say(`${name} was deleted.`);
      await refresh();
      $('gallery').querySelector('a, button')?.focus();
    } catch (error) {
      bin.disabled = false;
      facts.textContent = sentence(error.message);
      facts.classList.add('bad');
      say(error.message);
    }
  });
  return root;
}

let next = null;

async function list(address) {
  try {
    return await listPhotos(address);
  } catch (error) {
    $('gallery-note').hidden = false;
    $('gallery-note').textContent = sentence(error.message);
    return null;
  }
}

function show(page, more) {
  const cards = page.photos.filter((photo) => !isUnderWay(photo)).map((photo) => (photo.state === 'done' ? card(photo) : failedCard(photo)));
  if (more) $('gallery').append(...cards);
  else $('gallery').replaceChildren(...cards);
  $('gallery-note').hidden = $('gallery').children.length > 0;
  $('gallery-note').textContent = 'No photo yet. The first one takes a few seconds.';
  next = page.next ?? null;
  $('more').hidden = !next;
}

async function refresh() {
  const page = await list();
  if (page) show(page, false);
  return page;
}

/** Photos that were on their way when the page was opened. */
function resume(photos) {
  for (const photo of photos) {
    if (!isUnderWay(photo) || rows.has(photo.id)) continue;
    follow(photo, new Row(photoName(photo), null));
  }
}

$('more').addEventListener('click', async () => {
  $('more').disabled = true;
  const page = await list(next);
  if (page) show(page, true);
  $('more').disabled = false;
});

// ---- picker, drop, paste

$('picker').addEventListener('change', () => {
  take([...$('picker').files]);
  $('picker').value = '';
});

let depth = 0;
const carriesFiles = (event) => event.dataTransfer?.types.includes('Files');
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
addEventListener('drop', (event) => {
  if (!carriesFiles(event)) return;
  event.preventDefault();
  depth = 0;
  $('drop').classList.remove('over');
  take([...event.dataTransfer.files]);
});
addEventListener('paste', (event) => {
  const files = [...(event.clipboardData?.files ?? [])];
  if (!files.length) return;
  event.preventDefault();
  take(files);
});

refresh().then((page) => page && resume(page.photos));

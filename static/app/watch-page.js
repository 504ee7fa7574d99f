// The viewers' page of a room.

import { sentence } from '../i18n/format.js';
import { t, translatePage } from '../i18n/messages.js';
import { hasGyroscope } from '../input/gyroscope.js';
import { pictureDelay, statusText } from '../live/room-status.js';
import { SoundPlayer } from '../live/sound-player.js';
import { startRoom } from '../live/start.js';
import { Viewer } from '../view/viewer.js';
import { $ } from './dom.js';
import { roomOf } from './room-name.js';

/** How long a hint is shown, ms. */
const NOTE_MS = 5000;

const room = roomOf();
const narrow = matchMedia('(max-width: 640px)');
const sound = new SoundPlayer();
/** @type {ReturnType<typeof setTimeout> | undefined} */
let fading;
let shown = false;
/** The shown picture has no depth yet. */
let early = false;

/**
 * Shows a note over the picture.
 * @param {string} text
 * @param {boolean} [stays]
 */
function note(text, stays = false) {
  const line = $('live-note');
  line.textContent = text;
  line.classList.toggle('on', text !== '');
  clearTimeout(fading);
  if (text && !stays) fading = setTimeout(() => line.classList.remove('on'), NOTE_MS);
}

/** @param {string} message */
function fail(message) {
  $('loading').hidden = true;
  $('tools').hidden = true;
  $('failure-text').textContent = sentence(message);
  $('failure').hidden = false;
}

/** @param {{state: string, reason: string}} told */
function showState({ state, reason }) {
  document.body.dataset.state = state;
  // there are no statistics while the picture stands still
  if (state !== 'live') $('readout').textContent = '';
  const { over, text } = statusText({ state, reason });
  if (over) return fail(text);
  if (!shown) {
    $('loading').hidden = false;
    $('bar').hidden = state === 'waiting' || state === 'ended';
    $('loading-text').textContent = text;
  } else if (state !== 'live') note(text, true);
  else note(early ? t('The picture has no depth yet.') : '', true);
}

/** @param {{latency: number, lag: number, frames: number, kbits: number, viewers: number, madeMs: number, videoMs: number}} told */
function showStatistics(told) {
  Object.assign(window, { measured: told });
  if (!shown || document.body.dataset.state !== 'live') return;
  const late = pictureDelay(told);
  sound.late = late / 1000;
  const parts = [`${Math.round(late)} ms`, t('{0} frames/s', String(Math.round(told.frames)))];
  // a narrow screen needs that space for the room's name
  if (!narrow.matches) {
    parts.push(`${Math.round(told.kbits)} kbit/s`);
    if (told.viewers) parts.push(t('{0} watching', String(told.viewers)));
  }
  $('readout').textContent = parts.join(' · ');
}

/** @param {any} told by the room's worker */
function onLive(told) {
  if (told.type === 'state') showState(told);
  else if (told.type === 'statistics') showStatistics(told);
  else if (told.type === 'sound') sound.play(told);
  else if (told.type === 'has-sound') $('sound').hidden = !told.on;
}

async function toggleSound() {
  const on = $('sound').getAttribute('aria-pressed') !== 'true';
  if (on) await sound.start();
  else await sound.stop();
  viewer.postToWorker({ sound: on });
  $('sound').setAttribute('aria-pressed', String(on));
}

/** @param {boolean} on */
async function setTilt(on) {
  try {
    await viewer.setTilt(on);
  } catch {
    note(t('This browser does not allow it'));
  }
  $('tilt').setAttribute('aria-pressed', String(viewer.tilting));
}

async function toggleFullscreen() {
  if (document.fullscreenElement) await document.exitFullscreen();
  else await document.documentElement.requestFullscreen();
}

translatePage();
$('title').textContent = room.name;
document.title = `${room.name} – tmpi`;
const viewer = new Viewer($('stage'), { live: { start: startRoom, address: room.address, token: room.token } });
viewer.setIdle(false);
Object.assign(window, { viewer, sound });
viewer.addEventListener('live', ({ detail }) => onLive(detail));
viewer.addEventListener('ready', ({ detail }) => {
  const first = !shown;
  shown = true;
  $('stage').dataset.mode = detail.mode;
  $('loading').hidden = true;
  const was = early;
  early = Boolean(detail.early);
  if (early) return note(t('The picture has no depth yet.'), true);
  if (!first && !was) return;
  const drag = matchMedia('(pointer: coarse)').matches ? t('Drag to look around.') : t('Move the pointer or drag to look around.');
  note(detail.mode === 'flat' ? t('This browser shows the video without depth.') : drag);
});
viewer.addEventListener('error', ({ detail }) => fail(t(detail.message)));
$('reset').addEventListener('click', () => viewer.reset());
$('sound').addEventListener('click', () => toggleSound().catch(() => note(t('This browser does not allow it'))));
$('tilt').hidden = !hasGyroscope();
$('tilt').addEventListener('click', () => setTilt(!viewer.tilting));
$('retry').addEventListener('click', () => location.reload());
$('fullscreen').hidden = !document.fullscreenEnabled;
$('fullscreen').addEventListener('click', toggleFullscreen);
document.addEventListener('fullscreenchange', () =>
  $('fullscreen').setAttribute('aria-pressed', String(Boolean(document.fullscreenElement))),
);
document.addEventListener('visibilitychange', () => viewer.postToWorker({ hidden: document.hidden }));
document.addEventListener('keydown', (event) => {
  if (event.key === 'f' && !event.ctrlKey && !event.metaKey && !event.altKey && document.fullscreenEnabled) toggleFullscreen();
});
// the address has another token
addEventListener('hashchange', () => location.reload());

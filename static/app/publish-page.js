// The publisher's page of a room.

import { moment, sentence } from '../i18n/format.js';
import { t, translatePage } from '../i18n/messages.js';
import { fetchStatus, headersOf } from '../live/connection.js';
import { hasOpus } from '../live/microphone.js';
import { Publisher } from '../live/publisher.js';
import { $, element, isLoopback } from './dom.js';
import { linkTo, publishPage, roomNamed, roomOf } from './room-name.js';

/** Interval for updating the number of viewers, ms. */
const LOOK_MS = 2000;

let room = roomOf();
const named = $('room', HTMLInputElement);
const preview = $('preview', HTMLVideoElement);
const camera = $('camera', HTMLSelectElement);
/** @type {Publisher | null} */
let publisher = null;
/** @type {MediaStream | null} */
let stream = null;
/** @type {WakeLockSentinel | null} */
let awake = null;
/** @type {ReturnType<typeof setInterval> | undefined} */
let looking;

/** @param {string} text */
function say(text) {
  $('state').textContent = text;
}

/** @param {string} state */
function show(state) {
  document.body.dataset.state = state;
  const on = ['live', 'again', 'connecting', 'paused'].includes(state);
  document.body.classList.toggle('on', on);
  $('go').hidden = on;
  $('stop').hidden = !on;
  $('on-air').hidden = state !== 'live';
  for (const id of ['room', 'camera', 'size', 'with-sound']) $(id, /** @type {any} */ (HTMLElement)).toggleAttribute('disabled', on);
}

/** What the user can do if the camera is unavailable. */
function refusal(/** @type {Error} */ error) {
  if (error.name === 'NotAllowedError') return t('The camera is not allowed for this page. Allow it in the browser and start again.');
  if (error.name === 'NotFoundError' || error.name === 'OverconstrainedError') return t('There is no such camera.');
  if (error.name === 'NotReadableError') return t('Another program uses the camera.');
  return sentence(error.message);
}

/** Lists cameras; their names are known once the user has allowed one. */
async function listCameras() {
  const devices = (await navigator.mediaDevices.enumerateDevices()).filter(({ kind }) => kind === 'videoinput');
  const chosen = stream?.getVideoTracks()[0]?.getSettings().deviceId ?? camera.value;
  const options = devices.map(({ deviceId, label }, i) => {
    const option = element('option', '', label || t('Camera {0}', i + 1));
    option.value = deviceId;
    option.selected = deviceId === chosen;
    return option;
  });
  camera.replaceChildren(...(options.length ? options : [element('option', '', t('Any camera'))]));
}

async function openCamera() {
  const [width, height] = $('size', HTMLSelectElement).value.split('x').map(Number);
  const deviceId = camera.value && camera.value !== t('Any camera') ? { exact: camera.value } : undefined;
  const video = { width: { ideal: width }, height: { ideal: height }, frameRate: { ideal: 30 }, ...(deviceId && { deviceId }) };
  const sound = $('with-sound', HTMLInputElement).checked && (await hasOpus());
  const audio = sound ? { echoCancellation: true, noiseSuppression: true } : false;
  try {
    return await navigator.mediaDevices.getUserMedia({ video, audio });
  } catch (error) {
    // without a microphone, publish the picture alone
    if (!audio || error.name === 'NotAllowedError') throw error;
    return navigator.mediaDevices.getUserMedia({ video });
  }
}

function closeCamera() {
  for (const track of stream?.getTracks() ?? []) track.stop();
  stream = null;
  preview.srcObject = null;
  awake?.release().catch(() => {});
  awake = null;
  clearInterval(looking);
}

/** Whether sound is wanted but not sent. */
function lacksSound() {
  return Boolean(stream?.getAudioTracks().length && publisher && !publisher.hasSound);
}

/**
 * @param {string} state
 * @param {string} reason
 */
function onState(state, reason) {
  show(state);
  if (state === 'connecting') say(t('Connecting…'));
  else if (state === 'live') say(lacksSound() ? t('You are live, without sound: the microphone does not work.') : t('You are live.'));
  else if (state === 'paused')
    say(t('Paused: the camera gives no picture while this page is hidden. It continues by itself once the page is visible.'));
  else if (state === 'again') say(t('The connection broke. Trying again…'));
  else {
    closeCamera();
    say(reason ? t('It ended: {0}', t(reason)) : t('You are no longer live.'));
    $('share').hidden = true;
  }
}

async function start() {
  show('connecting');
  try {
    stream = await openCamera();
    preview.srcObject = stream;
    await preview.play();
    await listCameras();
    publisher = new Publisher(room, stream, preview, onState);
    Object.assign(window, { publisher });
    await publisher.start();
    awake = (await navigator.wakeLock?.request('screen').catch(() => null)) ?? null;
    await share();
    looking = setInterval(countViewers, LOOK_MS);
  } catch (error) {
    publisher?.stop();
    closeCamera();
    show('idle');
    say(refusal(error));
  }
}

/** A link for viewers: with a viewer's token, not with this page's. */
async function share() {
  const response = await fetch(`${room.address}/token`, { method: 'POST', headers: headersOf(room.token) });
  /** @type {{token: string | null}} */
  const { token } = response.ok ? await response.json() : { token: null };
  $('link', HTMLInputElement).value = linkTo(room.name, token);
  // a token begins with its expiry time
  const until = Number(token?.split('-')[0]);
  const notes = [
    until
      ? t('It is valid until {0}.', moment(until))
      : t('Rooms on this server are for this machine only: it has no key to let others in.'),
    ...(until && isLoopback() ? [t('This address works only on this machine. Others need the server’s name.')] : []),
  ];
  $('link-note').textContent = notes.join(' ');
  $('share').hidden = false;
}

async function countViewers() {
  const { viewers, publishing } = await fetchStatus(room.address, room.token);
  if (document.body.dataset.state !== 'live' || !publishing || lacksSound()) return;
  say(t('You are live. {0} watching.', String(viewers)));
}

/** Shows problems before publishing starts. */
async function check() {
  const asked = room;
  const { state, mayPublish, publishing } = await fetchStatus(room.address, room.token);
  if (asked !== room) return;
  if (state === 'none') return stay(t('There is no such room on this server.'));
  if (state === 'refused' || (state !== 'away' && !mayPublish))
    return stay(t('To go live here you need a link that is still valid. Ask the person who sent you the link for a new one.'));
  if (!navigator.mediaDevices?.getUserMedia) return stay(t('The camera needs an address with https.'));
  say(publishing ? t('Somebody is live in this room already. Give yours another name.') : beforehand);
  await listCameras();
}

/** @param {string} why nothing can be started */
function stay(why) {
  $('form').hidden = true;
  document.body.dataset.state = 'refused';
  say(why);
}

/** Opens the room with the name in the field. */
function rename() {
  if (!named.reportValidity() || named.value === room.name) return;
  room = roomNamed(named.value);
  history.replaceState(history.state, '', publishPage(room.name));
  showName();
  check();
}

function showName() {
  $('title').textContent = t('Go live: {0}', room.name);
  document.title = `${room.name} – tmpi`;
}

translatePage();
const beforehand = $('state').textContent ?? '';
named.value = room.name;
// a token is valid for one room only
named.readOnly = Boolean(room.token);
named.addEventListener('change', rename);
showName();
$('form').addEventListener('submit', (event) => {
  event.preventDefault();
  rename();
  start();
});
$('stop').addEventListener('click', () => publisher?.stop());
$('copy').addEventListener('click', async () => {
  const link = $('link', HTMLInputElement);
  try {
    await navigator.clipboard.writeText(link.value);
    $('link-note').textContent = t('Copied');
  } catch {
    link.select();
  }
});
addEventListener('pagehide', () => publisher?.stop());
check();

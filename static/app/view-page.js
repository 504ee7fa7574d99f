// The page of one photo.

import { decimal, formatBytes, queueText, sentence, stageText } from '../i18n/format.js';
import { t, translatePage } from '../i18n/messages.js';
import { hasGyroscope } from '../input/gyroscope.js';
import { hasHeadset } from '../input/xr.js';
import { EYES } from '../view/camera.js';
import { settingsOf } from '../view/settings.js';
import { Viewer } from '../view/viewer.js';
import './secret-link.js';
import { getPhoto, photoUrl } from './api.js';
import { showBackdrop } from './backdrop.js';
import { offerBetterDepth } from './better-depth.js';
import { handOver } from './delete-later.js';
import { depthSummary } from './depth-summary.js';
import { $ } from './dom.js';
import { showPictures } from './downloads.js';
import { followPhoto, isUnderWay } from './follow-photo.js';
import { photoName } from './photo-name.js';
import { photoWithVersion, settingsMenu } from './settings-menu.js';
import { offsetOfHash, shareLink } from './view-link.js';

/** @import { Photo } from './api.js' */
/** @import { Shared } from './dialog.js' */

const TOAST_MS = 2500;
const NOTE_MS = 7000;
/** Storage key: this browser has shown the hint on how to move. */
const HINTED = 'tmpi-hinted';
/** Maximum movement of the pointer between press and release of a click. */
const CLICK_PX = 5;

const id = decodeURIComponent(location.pathname.split('/').filter(Boolean).pop() ?? '');
const stage = $('stage');
/** @type {{bytes: number, ms: number | null, toast: number | undefined}} */
const state = { bytes: 0, ms: null, toast: undefined };
/** @type {Viewer} */
let viewer;
/**
 * The photo's visibility; undefined on a server without access control.
 * @type {Photo['visibility']}
 */
let visibility;
/** Settles when the photo's current picture has loaded or failed. */
let pictured = Promise.resolve();

/** @param {string} text */
function toast(text) {
  $('toast').textContent = text;
  $('toast').classList.add('on');
  clearTimeout(state.toast);
  state.toast = setTimeout(() => $('toast').classList.remove('on'), TOAST_MS);
}

function readout() {
  // the goal, not the current zoom: a slow machine may take long to get there
  const { goal, own } = viewer.zoom;
  const closer = goal > 1.01 ? [`${Math.round((goal / own) * 100)} %`] : [];
  const served = viewer.mode === 'served' ? [t('drawn by the server')] : [];
  $('readout').textContent = [...closer, ...served].join(' · ');
  const { head } = viewer;
  $('facts').textContent = [
    ...(head ? [`${head.width} × ${head.height}`] : []),
    ...(state.bytes ? [formatBytes(state.bytes)] : []),
    ...(state.ms === null ? [] : [`${state.ms < 9.95 ? decimal(state.ms, 1) : Math.round(state.ms)} ms`]),
  ].join(' · ');
}

/**
 * @param {string} text
 * @param {number} [share]
 */
function showLoading(text, share) {
  $('loading').hidden = false;
  $('loading-text').textContent = text;
  if (share === undefined) $('bar').removeAttribute('value');
  else $('bar', HTMLProgressElement).value = share;
}

/** @param {string} message */
function fail(message) {
  $('loading').hidden = true;
  $('tools').hidden = true;
  $('failure-text').textContent = sentence(message);
  $('failure').hidden = false;
}

/** @param {boolean} on */
function showIdle(on) {
  $('idle').setAttribute('aria-pressed', String(on));
}

/** Starts the viewer; waits first if the photo is not made yet. */
async function start() {
  /** @type {() => void} */
  let settle = () => {};
  pictured = new Promise((resolve) => (settle = resolve));
  // with the version in the address, browsers can cache it for good
  const version = (await known)?.state.version;
  viewer?.dispose();
  // no more pixels than the screen has
  const fit = Math.min(Math.ceil(Math.max(screen.width, screen.height) * devicePixelRatio), 65_535);
  viewer = new Viewer(stage, {
    atlas: photoUrl(id, `/atlas?fit=${fit}${version ? `&v=${version}` : ''}`),
    view: photoUrl(id, version ? `/view?v=${version}` : '/view'),
    report: photoUrl(id, version ? `/report?v=${version}` : '/report'),
    offset: offsetOfHash(),
    settings: known.then((answer) => settingsOf(answer?.state)),
    full: known.then((answer) => answer?.state),
  });
  applyMenu();
  // for tests and the console
  Object.assign(window, { viewer });
  showIdle(viewer.idle);
  viewer.addEventListener('progress', ({ detail: { received, total } }) => {
    state.bytes = total || received;
    showLoading(
      total ? t('{0} of {1}', formatBytes(received), formatBytes(total)) : formatBytes(received),
      total ? received / total : undefined,
    );
    readout();
  });
  viewer.addEventListener('photo', () => showBackdrop(viewer.poster).then(settle));
  viewer.addEventListener('error', settle);
  viewer.addEventListener('ready', ({ detail }) => {
    $('loading').hidden = true;
    stage.dataset.mode = detail.mode;
    $('show').hidden = $('picture').hidden = !viewer.renderer;
    offerHeadset();
    hint();
  });
  viewer.addEventListener('mode', ({ detail }) => {
    stage.dataset.mode = detail.mode;
    if (detail.mode !== 'served') return;
    $('show').hidden = $('picture').hidden = true;
    state.ms = null;
    note(t('The server draws this view. {0}', detail.reason));
    readout();
  });
  viewer.addEventListener('frame', ({ detail }) => {
    state.ms = detail.ms;
    readout();
    showNarrowed();
  });
  viewer.addEventListener('pose', readout);
  viewer.addEventListener('idle', ({ detail }) => showIdle(detail.on));
  viewer.addEventListener('error', ({ detail }) => {
    if (viewer.mode !== 'failed') toast(detail.message);
    else waitOrFail(detail.message);
  });
}

/** @param {string} message */
async function waitOrFail(message) {
  const photo = await getPhoto(id).catch(() => null);
  if (!photo)
    return fail(t('There is no photo at this address, or only its owner can see it. Ask the person who sent you the link for a new one.'));
  if (!isUnderWay(photo)) return fail(message);
  followPhoto(id, {
    queued: (position) => showLoading(queueText(position)),
    stage: (at) => showLoading(stageText(at.stage), (at.step - 1) / at.steps),
    done: start,
    failed: fail,
    deleted: () => fail(t('The photo was deleted.')),
  });
}

async function toggleFullscreen() {
  try {
    if (document.fullscreenElement) await document.exitFullscreen();
    else await document.documentElement.requestFullscreen();
  } catch {
    toast(t('This browser does not allow full screen'));
  }
}

/** Says that the eyes are closer together than the user set them. */
function showNarrowed() {
  const text = viewer.eyesNarrowed
    ? t('Closer together than set: what the eyes see would be more than 3 % of the width apart, which strains them.')
    : '';
  if ($('eyes-hint').textContent !== text) $('eyes-hint').textContent = text;
}

/** Applies the menu's settings to a new viewer. */
function applyMenu() {
  viewer.overlay = document.querySelector(/** @type {'input'} */ ('input[name=overlay]:checked'))?.value ?? 'none';
  viewer.stereo = $('stereo', HTMLSelectElement).value;
  viewer.eyeDistance = EYES * Number($('eyes', HTMLInputElement).value);
  $('eyes-label').hidden = !viewer.stereo;
  showNarrowed();
  viewer.blur = Number($('blur', HTMLInputElement).value);
  $('blur-hint').hidden = !viewer.blur;
}

/** A click without a drag sets the focus, if a depth-of-field blur is on. */
function focusOnClick() {
  /** @type {{clientX: number, clientY: number} | null} */
  let pressed = null;
  stage.addEventListener('pointerdown', ({ clientX, clientY }) => (pressed = { clientX, clientY }));
  stage.addEventListener('click', ({ clientX, clientY }) => {
    if (!viewer.blur || !viewer.canvas || !pressed || Math.hypot(clientX - pressed.clientX, clientY - pressed.clientY) > CLICK_PX) return;
    const box = viewer.canvas.getBoundingClientRect();
    viewer.focusAt((clientX - box.x) / box.width, (clientY - box.y) / box.height).catch((error) => toast(error.message));
  });
}

/** @param {string} text */
function note(text) {
  $('served-note').textContent = text;
  $('served-note').classList.add('on');
  setTimeout(() => $('served-note').classList.remove('on'), NOTE_MS);
}

/** Shows once per browser how to move the view. */
function hint() {
  if (viewer.mode === 'served' || localStorage.getItem(HINTED)) return;
  localStorage.setItem(HINTED, '1');
  note(
    matchMedia('(pointer: coarse)').matches
      ? t('Drag to look around; pinch or tap twice to come closer.')
      : t('Point or drag to look around; scroll or double-click to come closer.'),
  );
  // a user who moves the view needs no hint
  for (const type of ['pointerdown', 'wheel']) {
    stage.addEventListener(type, () => $('served-note').classList.remove('on'), { once: true, passive: true });
  }
}

/** Offers tilting on phones at the first touch: browsers ask for permission only on a user gesture. */
function offerTilt() {
  const offer = $('tilt-offer');
  const asked = ({ pointerType = '' }) => {
    if (pointerType !== 'touch' || !viewer.renderer) return;
    stage.removeEventListener('pointerup', asked);
    if (viewer.tilting) return;
    offer.hidden = false;
    setTimeout(() => (offer.hidden = true), NOTE_MS);
  };
  if (hasGyroscope()) stage.addEventListener('pointerup', asked);
  offer.addEventListener('click', () => {
    offer.hidden = true;
    tilt.click();
  });
}

/** @param {KeyboardEvent} event */
function onKey({ key, target, ctrlKey, metaKey, altKey }) {
  if (ctrlKey || metaKey || altKey || (target instanceof HTMLElement && target.matches('input, select'))) return;
  if (key === 'f' && document.fullscreenEnabled) toggleFullscreen();
  if (key === '?') note($('keys').textContent?.trim().replace(/\s+/g, ' ') ?? '');
}

/** Offers the headset, only if the browser draws and supports one. */
async function offerHeadset() {
  $('headset').hidden = !viewer.renderer || !(await hasHeadset());
}

async function savePicture() {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(await viewer.picture());
  link.download = container.download.replace(/\.tmpi$/, '.png');
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), NOTE_MS);
}

/** Opens the touch-up of the depth; shows the photo again once it was remade. */
async function touchUp() {
  $('settings-menu').hidePopover();
  try {
    const { openTouchUp } = await import('./touch-up.js');
    await pictured;
    await openTouchUp({ id, photo: viewer.poster, saved: showAgain, say: toast });
  } catch (error) {
    toast(error.message);
  }
}

/** Reloads the photo. */
async function showAgain() {
  known = photoWithVersion(id).catch(() => null);
  showLoading(t('Loading…'));
  await start();
  const answer = await known;
  if (answer) menu.read(answer);
  showDepthSource();
}

/** Shows how the depth was made when the menu opens. */
async function showDepthSource() {
  const line = $('depth-source');
  const version = (await known)?.state.version;
  const answer = await fetch(photoUrl(id, version ? `/report?v=${version}` : '/report')).catch(() => null);
  if (!answer?.ok) return;
  const report = await answer.json();
  line.textContent = depthSummary(report);
  line.hidden = false;
  offerBetterDepth($('better-depth'), { id, model: report.depth_model, made: showAgain });
}

const container = $('download', HTMLAnchorElement);
$('show-menu').addEventListener('beforetoggle', showDepthSource, { once: true });
$('show-menu').addEventListener('change', applyMenu);
$('touch-up').addEventListener('click', touchUp);
$('delete').addEventListener('click', () => handOver(id, $('title').textContent ?? ''));
$('picture').addEventListener('click', () => savePicture().catch((error) => toast(error.message)));
$('tilt-label').hidden = !hasGyroscope();
const tilt = $('tilt', HTMLInputElement);
tilt.addEventListener('change', async () => {
  try {
    await viewer.setTilt(tilt.checked);
    if (tilt.checked) viewer.setIdle(false);
  } catch {
    tilt.checked = false;
    toast(t('This browser does not allow it'));
  }
});
offerTilt();
document.addEventListener('keydown', onKey);
$('eyes').addEventListener('input', applyMenu);
$('blur').addEventListener('input', () => {
  applyMenu();
  // drawing a moving picture with blur may be too slow to show the change
  if (viewer.blur) viewer.setIdle(false);
});
focusOnClick();
$('headset').addEventListener('click', () => viewer.enterHeadset().catch(() => toast(t('This browser does not allow it'))));
navigator.xr?.addEventListener?.('devicechange', offerHeadset);
$('reset').addEventListener('click', () => viewer.reset());
$('idle').addEventListener('click', () => viewer.setIdle(!viewer.idle));
/** @type {Record<string, () => Promise<{open: (photo: Shared) => Promise<HTMLDialogElement>}>>} */
const DIALOGS = {
  link: () => import('./link-dialog.js'),
  film: () => import('./film-dialog.js'),
  embed: () => import('./embed-dialog.js'),
  access: () => import('./access-dialog.js'),
};
for (const [name, load] of Object.entries(DIALOGS)) {
  $(`share-${name}`).addEventListener('click', async () => {
    $('share-menu').hidePopover();
    try {
      // the link depends on the visibility
      await known;
      if (name === 'link' && visibility !== 'private') return await shareLink(viewer.motion.now, toast);
      const { open } = await load();
      const file = container.download.replace(/\.tmpi$/, '');
      await open({ id, viewer, name: $('title').textContent ?? '', file, visibility, changed: showVisibility });
    } catch (error) {
      toast(error.message);
    }
  });
}
$('retry').addEventListener('click', () => location.reload());
container.href = photoUrl(id, '/atlas');
container.download = `${id}.tmpi`;
for (const link of document.querySelectorAll(/** @type {'a'} */ ('[data-export]')))
  link.href = photoUrl(id, `/export?format=${link.dataset.export}`);
$('download-menu').addEventListener('beforetoggle', () => showPictures(id, container.download.replace(/\.tmpi$/, ''), viewer.pivot));
$('fullscreen').hidden = !document.fullscreenEnabled;
$('fullscreen').addEventListener('click', toggleFullscreen);
document.addEventListener('fullscreenchange', () =>
  $('fullscreen').setAttribute('aria-pressed', String(Boolean(document.fullscreenElement))),
);
addEventListener('hashchange', () => {
  const offset = offsetOfHash();
  if (offset) viewer.moveTo(offset);
});

/**
 * Takes over the photo's visibility and shows it beside the settings menu.
 * @param {{state: Photo, etag: string | null}} answer
 */
function showVisibility(answer) {
  visibility = answer.state.visibility;
  menu.follow(answer);
}

/** @param {Photo} photo */
function showName(photo) {
  const name = photoName(photo);
  $('title').textContent = name;
  document.title = `${name} – tmpi`;
  container.download = `${name.replace(/[^\p{L}\p{M}\p{N}._-]+/gu, '-')}.tmpi`;
}

translatePage();
// the viewer reports what is wrong with the photo
let known = photoWithVersion(id).catch(() => null);
const menu = settingsMenu({ id, viewer: () => viewer, named: showName, say: toast });
start();
known.then((answer) => {
  $('settings').hidden = !answer?.state.settings;
  if (!answer) return;
  showName(answer.state);
  menu.read(answer);
  visibility = answer.state.visibility;
  $('share-access').hidden = !visibility;
});

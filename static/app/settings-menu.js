// The menu with which a photo's owner sets how viewers move: shows the settings, previews changes, and saves them with the photo.

import { t } from '../i18n/messages.js';
import { STYLES } from '../input/camera-motion.js';
import { settingsOf } from '../view/settings.js';
import { changeSettings, photoUrl } from './api.js';
import { $ } from './dom.js';

/** @import { Photo } from './api.js' */
/** @import { Viewer } from '../view/viewer.js' */
/** @import { Settings } from '../view/settings.js' */

/**
 * Fills the menu and listens to it.
 * @param {{id: string, viewer: () => Viewer, named: (state: Photo) => void, say: (text: string) => void}} page the photo, its current
 *   viewer, what to do with a saved state, and how to show a message
 */
export function settingsMenu({ id, viewer, named, say }) {
  const [title, motion, focus, speed] = ['set-title', 'set-motion', 'set-focus', 'set-speed'].map((name) => $(name, HTMLInputElement));
  const idle = $('set-idle', HTMLSelectElement);
  /** @type {string | null} */
  let etag = null;
  /** @type {Settings} */
  let settings = {};
  /**
   * Unsaved changes: a merge patch.
   * @type {{[K in keyof Settings]: Settings[K] | null}}
   */
  let patch = {};

  const unsaved = () => Object.keys(patch).length > 0;

  /** The settings with the unsaved changes. */
  const now = () =>
    /** @type {Settings} */ (Object.fromEntries(Object.entries({ ...settings, ...patch }).filter(([, value]) => value !== null)));

  function show() {
    const all = now();
    // do not overwrite the title while the user types
    if (document.activeElement !== title) title.value = all.title ?? '';
    // 1 is the photo's own range of motion
    motion.value = String(all.motion ? all.motion.x / viewer().defaultShares.x : 1);
    idle.value = all.idle ?? STYLES[0];
    speed.value = String(all.speed ?? 1);
    focus.value = String(all.focus ?? viewer().pivot ?? 0.35);
    $('set-start').setAttribute('aria-pressed', String(Boolean(all.start)));
    $('set-poster').setAttribute('aria-pressed', String(Boolean(all.poster)));
    $('set-save', HTMLButtonElement).disabled = !unsaved();
  }

  /** @param {typeof patch} more */
  function change(more) {
    Object.assign(patch, more);
    viewer().settings = now();
    show();
  }

  /** The camera's position in the view box. */
  const place = () => {
    const { x, y, z } = viewer().place;
    const short = (/** @type {number} */ v) => Math.round(Math.max(-1, Math.min(1, v)) * 1e3) / 1e3;
    return { x: short(x), y: short(y), z: short(z) };
  };

  /** @param {Event} [event] */
  async function save(event) {
    event?.preventDefault();
    try {
      const answer = await changeSettings(id, patch, etag);
      read(answer);
      named(answer.state);
      say(t('Saved'));
    } catch (error) {
      say(error.message);
    }
  }

  /**
   * Takes over the server's state.
   * @param {{state: Photo, etag: string | null}} answer
   */
  function read(answer) {
    etag = answer.etag;
    settings = settingsOf(answer.state);
    patch = {};
    show();
  }

  /**
   * Takes over the server's state after another change, and keeps unsaved changes.
   * @param {{state: Photo, etag: string | null}} answer
   */
  function follow(answer) {
    etag = answer.etag;
    settings = settingsOf(answer.state);
    show();
  }

  title.addEventListener('input', () => change({ title: title.value.trim() || null }));
  motion.addEventListener('input', () => {
    const by = Number(motion.value);
    const { x, y, z } = viewer().defaultShares;
    const share = (/** @type {number} */ v) => Math.min(1, Math.round(v * by * 1e4) / 1e4);
    change({ motion: by === 1 ? null : { x: share(x), y: share(y), z: share(z) } });
  });
  idle.addEventListener('change', () => {
    change({ idle: idle.value === STYLES[0] ? null : idle.value });
    viewer().setIdle(idle.value !== 'none');
  });
  speed.addEventListener('input', () => change({ speed: Number(speed.value) === 1 ? null : Number(speed.value) }));
  focus.addEventListener('input', () => change({ focus: Number(focus.value) }));
  $('set-start').addEventListener('click', () => change({ start: now().start ? null : place() }));
  $('set-poster').addEventListener('click', () => change({ poster: now().poster ? null : place() }));
  $('set-clear').addEventListener('click', () => change({ motion: null, focus: null, start: null, idle: null, speed: null, poster: null }));
  $('set-form').addEventListener('submit', save);
  $('settings-menu').addEventListener('toggle', (event) => {
    show();
    const closes = 'newState' in event && event.newState === 'closed';
    if (closes && unsaved()) say(t('Not saved yet. Save it in the Settings menu.'));
  });
  // the browser asks whether to leave
  addEventListener('beforeunload', (event) => unsaved() && event.preventDefault());
  return { read, follow, settings: () => settings };
}

/**
 * The state of a photo with its version, as `settingsMenu().read` takes it.
 * @param {string} id
 * @returns {Promise<{state: Photo, etag: string | null}>}
 */
export async function photoWithVersion(id) {
  const response = await fetch(photoUrl(id));
  if (!response.ok) throw new Error(String(response.status));
  return { state: await response.json(), etag: response.headers.get('etag') };
}

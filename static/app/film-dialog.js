// Makes a film or a GIF of a photo, shows it, and downloads it or hands it to another program.

import { STYLES } from '../film/camera-path.js';
import { makeFilm } from '../film/film.js';
import { encoding } from '../film/video.js';
import { formatBytes, sentence } from '../i18n/format.js';
import { t } from '../i18n/messages.js';
import { button, showDialog } from './dialog.js';
import { element } from './dom.js';

/** @import { Shared } from './dialog.js' */
/** @import { FilmOptions } from '../film/plan.js' */

const SECONDS = [2, 4, 8];
/** Longer sides in pixels: those below the photo's own are offered, and the photo's own up to the largest. */
const SIDES = [480, 720, 1280, 1920];
/** Default sizes by kind. */
const DEFAULT_SIDE = { mp4: 1280, webm: 1280, gif: 480 };
/** Names of the camera paths: as in a photo's settings, and after the command line's names. */
const NAMES = /** @type {Record<string, string>} */ ({
  swing: t('Swing: from side to side'),
  orbit: t('Orbit: in a circle'),
  dolly: t('Dolly: forward and back'),
  'dolly-zoom': t('Dolly zoom: back, with the lens'),
  zoom: t('Zoom: into the nearest thing'),
  wiggle: t('Wigglegram'),
});

/**
 * Shows the dialog.
 * @param {Shared} photo
 */
export async function open({ viewer, file }) {
  const { head } = viewer;
  if (!viewer.renderer || !head) throw new Error(t('A film can be made only where the browser itself draws the photo.'));
  const longest = Math.max(head.width, head.height);
  const small = { width: 640, height: 400, frameMs: 33 };
  const film = /** @type {const} */ (['mp4', 'webm']);
  const able = await Promise.all(film.map((kind) => encoding(small, kind)));
  // one kind of film is enough, and MP4 plays everywhere
  const best = film.find((_, i) => able[i]);
  const kinds = [...(best ? [best] : []), 'gif'];
  const kind = choice(
    t('Kind'),
    kinds.map((name) => [name, name === 'gif' ? 'GIF' : t('Film (.{0})', name)]),
  );
  const style = choice(
    t('Movement'),
    STYLES.map((name) => [name, NAMES[name] ?? name]),
  );
  const seconds = choice(
    t('Length'),
    SECONDS.map((s) => [String(s), t('{0} seconds', s)]),
    '4',
  );
  const own = Math.min(longest, SIDES[SIDES.length - 1]);
  const sides = [...SIDES.filter((s) => s < own), own];
  const side = choice(
    t('Longer side'),
    sides.map((s) => [String(s), t('{0} pixels', s)]),
  );
  const chooseDefaultSide = () => {
    const wanted = DEFAULT_SIDE[/** @type {FilmOptions['kind']} */ (kind.select.value)];
    side.select.value = String(sides.filter((s) => s <= wanted).pop() ?? sides[0]);
  };
  kind.select.addEventListener('change', chooseDefaultSide);
  chooseDefaultSide();

  const fields = element('fieldset', 'fields', kind.label, style.label, seconds.label, side.label);
  const bar = element('progress');
  bar.max = 1;
  bar.setAttribute('aria-label', t('Progress of the film'));
  const note = element('p');
  note.setAttribute('role', 'status');
  const shown = element('div');
  const make = button(t('Make it'), run, 'primary');
  const cancel = button(t('Cancel'), () => stop?.abort());
  const save = element('a', 'button primary', t('Save'));
  const send = button(t('Send…'), () => {}, '');
  const work = element('div', 'row actions', make, bar, cancel, save, send);
  bar.hidden = cancel.hidden = save.hidden = send.hidden = true;
  /** @type {AbortController | null} */
  let stop = null;
  let address = '';

  /** Discards the shown film. */
  function forget() {
    shown.replaceChildren();
    save.hidden = send.hidden = true;
    if (address) URL.revokeObjectURL(address);
    address = '';
  }

  async function run() {
    forget();
    stop = new AbortController();
    /** @type {FilmOptions} */
    const wish = {
      kind: /** @type {FilmOptions['kind']} */ (kind.select.value),
      style: style.select.value,
      seconds: Number(seconds.select.value),
      side: Number(side.select.value),
    };
    fields.disabled = true;
    make.hidden = true;
    bar.hidden = cancel.hidden = false;
    bar.value = 0;
    note.textContent = '';
    cancel.focus();
    try {
      const blob = await makeFilm(viewer, wish, { signal: stop.signal, progress: (share) => (bar.value = share) });
      show(new File([blob], `${file}-${wish.style}.${wish.kind}`, { type: blob.type }));
    } catch (error) {
      note.textContent = error.name === 'AbortError' ? t('Cancelled.') : sentence(t(error.message));
    } finally {
      stop = null;
      fields.disabled = false;
      make.hidden = false;
      bar.hidden = cancel.hidden = true;
      if (save.hidden) make.focus();
      else save.focus();
    }
  }

  /** @param {File} film */
  function show(film) {
    address = URL.createObjectURL(film);
    const picture = film.type.startsWith('image/') ? element('img', 'film') : element('video', 'film');
    if (picture instanceof HTMLVideoElement)
      Object.assign(picture, { loop: true, muted: true, autoplay: true, playsInline: true, controls: true });
    else picture.alt = t('The film');
    picture.src = address;
    shown.replaceChildren(picture);
    save.href = address;
    save.download = film.name;
    save.hidden = false;
    send.hidden = !navigator.canShare?.({ files: [film] });
    send.onclick = () => navigator.share({ files: [film] }).catch(() => {});
    note.textContent = formatBytes(film.size);
  }

  const hints =
    kinds.length === 1 ? [element('p', '', t('Films need a newer browser, and an address with https; a GIF can be made here.'))] : [];
  const dialog = await showDialog(t('A film or GIF'), ...hints, fields, note, shown, work);
  dialog.addEventListener('close', () => {
    stop?.abort();
    forget();
  });
  return dialog;
}

/**
 * A select with options.
 * @param {string} title
 * @param {string[][]} options values and what they are called
 * @param {string} [chosen]
 */
function choice(title, options, chosen) {
  const select = element('select');
  for (const [value, text] of options) select.append(new Option(text, value, false, value === chosen));
  return { select, label: element('label', '', title, select) };
}

// What a photo is called.
import { t } from '../i18n/messages.js';

/** @import { Photo } from './api.js' */

/** Names of files that browsers kept before servers did. */
const NAME_KEY = 'tmpi:name:';

/** @param {string} id */
export function forgetName(id) {
  try {
    localStorage.removeItem(NAME_KEY + id);
  } catch {
    // storage is forbidden: the date has to do
  }
}

/**
 * What to call a photo: its title, which is its file's name at first, or when it was made.
 * @param {Photo} photo
 */
export function photoName(photo) {
  if (photo.settings?.title) return photo.settings.title;
  /** @type {string | null} */
  let name = null;
  try {
    name = localStorage.getItem(NAME_KEY + photo.id);
  } catch {
    // as above
  }
  if (name) return name.replace(/\.[a-z0-9]{2,5}$/i, '');
  const date = new Date(photo.created);
  if (Number.isNaN(date.getTime())) return t('Photo');
  const year = date.getFullYear() === new Date().getFullYear() ? undefined : 'numeric';
  return date.toLocaleString(undefined, { year, month: 'short', day: 'numeric', hour: 'numeric', minute: '2-digit' });
}

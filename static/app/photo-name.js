// The name of a photo.
import { t } from '../i18n/messages.js';

/** @import { Photo } from './api.js' */

/** Key of file names that older versions stored in the browser. */
const NAME_KEY = 'tmpi:name:';

/** @param {string} id */
export function forgetName(id) {
  try {
    localStorage.removeItem(NAME_KEY + id);
  } catch {
    // storage is forbidden: use the date
  }
}

/**
 * A photo's name: its title (by default its file name), or when it was made.
 * @param {Photo} photo
 */
export function photoName(photo) {
  if (photo.settings?.title) return photo.settings.title;
  /** @type {string | null} */
  let name = null;
  try {
    name = localStorage.getItem(NAME_KEY + photo.id);
  } catch {
    // storage is forbidden
  }
  if (name) return name.replace(/\.[a-z0-9]{2,5}$/i, '');
  const date = new Date(photo.created);
  if (Number.isNaN(date.getTime())) return t('Photo');
  const year = date.getFullYear() === new Date().getFullYear() ? undefined : 'numeric';
  return date.toLocaleString(undefined, { year, month: 'short', day: 'numeric', hour: 'numeric', minute: '2-digit' });
}

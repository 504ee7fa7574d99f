// What a photo is called.
import { t } from '../i18n/messages.js';

const NAME_KEY = 'tmpi:name:';

/** The name of the file that a photo came from is known only to the browser that sent it. */
export function rememberName(id, name) {
  try {
    localStorage.setItem(NAME_KEY + id, name);
  } catch {
    // storage is full or forbidden: the date has to do
  }
}

export function forgetName(id) {
  try {
    localStorage.removeItem(NAME_KEY + id);
  } catch {
    // as above
  }
}

/** What to call a photo: its title, its file's name without the ending, or when it was made. */
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

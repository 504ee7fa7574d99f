// The name of a photo.
import { t } from '../i18n/messages.js';

/** @import { Photo } from './api.js' */

/**
 * A photo's name: its title (by default its file name), or when it was made.
 * @param {Photo} photo
 */
export function photoName(photo) {
  if (photo.settings?.title) return photo.settings.title;
  const date = new Date(photo.created);
  if (Number.isNaN(date.getTime())) return t('Photo');
  const year = date.getFullYear() === new Date().getFullYear() ? undefined : 'numeric';
  return date.toLocaleString(undefined, { year, month: 'short', day: 'numeric', hour: 'numeric', minute: '2-digit' });
}

// A link with which others can see a photo for a while: its duration, when it expires, and the link to copy.

import { moment } from '../i18n/format.js';
import { t } from '../i18n/messages.js';
import { linksOf } from './api.js';
import { copied } from './dialog.js';
import { element, isLoopback } from './dom.js';

/** @import { PhotoLinks } from './api.js' */

const HOUR = 3600;
const DAY = 24 * HOUR;
/** Default duration of a link, in seconds. */
export const USUAL_SECONDS = DAY;
/**
 * Offered durations of a link, in seconds.
 * @type {[string, string][]}
 */
const TIMES = [
  [String(HOUR), t('An hour')],
  [String(DAY), t('A day')],
  [String(7 * DAY), t('A week')],
  [String(30 * DAY), t('30 days')],
];

export const absolute = (/** @type {string} */ path) => new URL(path, location.origin).href;

/** @param {[string, string][]} options values with their words */
export function select(options) {
  const box = element('select');
  for (const [value, word] of options) box.add(new Option(word, value));
  return box;
}

/**
 * Shows a photo's link that expires, and creates another when the user picks another duration.
 * @param {string} id of the photo
 * @param {PhotoLinks} links good for {@link USUAL_SECONDS}
 * @param {string} title what the link is
 * @param {string} [hash] of the link's address
 */
export function expiringLink(id, links, title, hash = '') {
  const time = select(TIMES);
  time.value = String(USUAL_SECONDS);
  const said = element('p');
  said.setAttribute('role', 'status');
  const link = copied(title, '');
  /** @param {PhotoLinks} made */
  function show({ page, expires }) {
    link.text.value = absolute(page) + hash;
    said.textContent = expires ? t('Anyone with this link can see the photo until {0}, but not change it.', moment(expires)) : '';
  }
  /** Creates a new link. */
  async function renew() {
    const made = await linksOf(id, Number(time.value));
    show(made);
    return made;
  }
  time.addEventListener('change', () =>
    renew().catch((error) => {
      // do not show a link of another duration
      link.text.value = '';
      said.textContent = error.message;
    }),
  );
  show(links);
  const local = isLoopback() ? [element('p', '', t('This address works only on this machine. Others need the server’s name.'))] : [];
  const parts = [said, ...local, element('div', 'fields', element('label', '', t('Valid for'), time)), ...link.parts];
  return { text: link.text, parts, renew };
}

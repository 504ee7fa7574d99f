// The access dialog of a photo: who may see it (everybody with the link, or only holders of a link that expires), who else may change it,
// and how another browser becomes the same owner. Shown only on servers with access control.

import { t } from '../i18n/messages.js';
import { changeSettings, linksOf, ownerTicket, takeLinksBack } from './api.js';
import { button, copied, showDialog } from './dialog.js';
import { at, element } from './dom.js';
import { absolute, expiringLink, select, USUAL_SECONDS } from './expiring-link.js';

/** @import { Shared } from './dialog.js' */

/**
 * Shows the dialog.
 * @param {Shared} photo
 */
export async function open({ id, visibility, changed }) {
  const links = await linksOf(id, USUAL_SECONDS).catch(() => null);
  if (!links) return showDialog(t('Who may see it'), element('p', '', t('Only the person who uploaded the photo decides who may see it.')));
  const seen = select([
    ['private', t('Only me')],
    ['link', t('Anyone with the link')],
  ]);
  // the visible heading has the same text
  seen.setAttribute('aria-label', t('Who may see it'));
  const said = element('p');
  said.setAttribute('role', 'status');
  let now = visibility ?? 'private';
  seen.value = now;
  const link = expiringLink(id, links, t('A link with an end date'));
  const ending = element('section', '', element('h3', '', t('A link with an end date')), ...link.parts);
  ending.hidden = now !== 'private';
  seen.addEventListener('change', async () => {
    try {
      changed(await changeSettings(id, { visibility: seen.value }, null));
      now = seen.value === 'link' ? 'link' : 'private';
      said.textContent = t('Saved');
    } catch (error) {
      seen.value = now;
      said.textContent = error.message;
    }
    ending.hidden = now !== 'private';
  });
  const others = somebodyElse(
    links.manage,
    () => takeLinksBack(id),
    async () => (await link.renew()).manage,
  );
  return showDialog(
    t('Who may see it'),
    element('section', '', seen, said),
    ending,
    ...others,
    ...(links.ticket ? [otherBrowser(id)] : []),
  );
}

/**
 * The link with which others can change this photo, and a button to revoke all links; empty if the server returns no such link.
 * @param {string | undefined} manage
 * @param {() => Promise<void>} takeBack
 * @param {() => Promise<string | undefined>} anew shows the current links; returns the one to change the photo
 */
function somebodyElse(manage, takeBack, anew) {
  if (!manage) return [];
  const link = copied(t('A link to change it'), absolute(manage));
  const said = element('p');
  said.setAttribute('role', 'status');
  const back = button(t('Take all links back'), async () => {
    try {
      await takeBack();
      link.text.value = absolute((await anew()) ?? '');
      said.textContent = t('Earlier links no longer work; these are new.');
    } catch (error) {
      // a holder of a manage link cannot revoke it
      said.textContent = error.status === 404 ? t('Only the person who uploaded the photo can take its links back.') : error.message;
    }
  });
  return [
    element(
      'details',
      '',
      element('summary', '', t('Let somebody else change it')),
      element(
        'p',
        '',
        t('A secret: anyone who opens this link can see, change and delete this photo, and no other, until you take it back.'),
      ),
      ...link.parts,
      element('div', 'row', back),
      said,
    ),
  ];
}

/**
 * Makes another browser the same owner as this one.
 * @param {string} id
 */
function otherBrowser(id) {
  const link = copied(t('The link for your other browser'), '');
  const shown = element('div', 'made', ...link.parts);
  shown.hidden = true;
  const said = element('p');
  said.setAttribute('role', 'status');
  const make = button(t('Make a link'), async () => {
    try {
      link.text.value = absolute(at(`/view/${encodeURIComponent(id)}#owner=${await ownerTicket()}`));
      shown.hidden = false;
      said.textContent = t('Valid for 15 minutes.');
      // it may be below the visible part of the dialog
      said.scrollIntoView({ block: 'nearest' });
    } catch (error) {
      said.textContent = error.message;
    }
  });
  return element(
    'details',
    '',
    element('summary', '', t('For another browser of yours')),
    element(
      'p',
      '',
      t('A secret: anyone who opens this link in time can see, change and delete all your photos, and that cannot be taken back.'),
    ),
    element('div', 'row', make),
    shown,
    said,
  );
}

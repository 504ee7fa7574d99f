// A link to a view of a private photo: others could not open it without the owner's permission, which this dialog gives.

import { linkOf } from '../element/signed-link.js';
import { moment } from '../i18n/format.js';
import { t } from '../i18n/messages.js';
import { changeSettings, linksOf } from './api.js';
import { button, copied, showDialog } from './dialog.js';
import { element } from './dom.js';
import { expiringLink, USUAL_SECONDS } from './expiring-link.js';
import { addressAt, canSend } from './view-link.js';

/** @import { Shared } from './dialog.js' */

/**
 * Shows the dialog.
 * @param {Shared} photo
 */
export async function open({ id, viewer, changed }) {
  const title = t('Link to this view');
  const links = await linksOf(id, USUAL_SECONDS).catch(() => null);
  const view = { ...viewer.motion.now };
  const address = addressAt(view);
  if (!links) return byOwnLink(title, address);
  const link = expiringLink(id, links, title, new URL(address).hash);
  const shown = element(
    'section',
    '',
    element('p', '', t('Only you can see this photo.')),
    ...link.parts,
    ...sending(() => link.text.value),
  );
  const everybody = element(
    'section',
    '',
    element('p', '', t('Or let anyone who has its address see it, with no end date.')),
    element('div', 'row', button(t('Let anyone with the link see it'), allow)),
  );
  async function allow() {
    try {
      changed(await changeSettings(id, { visibility: 'link' }, null));
      const plain = addressAt(view, { signed: false });
      shown.replaceChildren(
        element('p', '', t('Anyone with the link can see it.')),
        ...copied(title, plain).parts,
        ...sending(() => plain),
      );
      everybody.remove();
    } catch (error) {
      everybody.replaceChildren(element('p', '', error.message));
    }
  }
  return showDialog(title, shown, everybody);
}

/**
 * For a photo of another owner: the only link is the one with which this page was opened.
 * @param {string} title
 * @param {string} address
 */
function byOwnLink(title, address) {
  const own = new URLSearchParams(linkOf(location.search));
  const expires = Number(own.get('expires'));
  if (!expires) return showDialog(title, element('p', '', t('Only the person who uploaded the photo can make a link for others.')));
  const said = t('Anyone with this link can see the photo until {0}, but not change it.', moment(expires));
  return showDialog(title, element('section', '', element('p', '', said), ...copied(title, address).parts, ...sending(() => address)));
}

/**
 * A button that hands a link to another program, if the browser can.
 * @param {() => string} url
 */
function sending(url) {
  if (!canSend()) return [];
  const send = button(t('Send…'), () => navigator.share({ title: document.title, url: url() }).catch(() => {}), 'primary');
  return [element('div', 'row', send)];
}

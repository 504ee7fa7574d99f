// Confirmations before a browser becomes another owner: the maker of the link would own everything uploaded from here.

import { t } from '../i18n/messages.js';
import { button, showDialog } from './dialog.js';
import { element } from './dom.js';

/** True if the user confirms that they made the link for this browser. */
export const isMine = () =>
  ask(
    t('Is this link your own?'),
    t(
      'It makes this browser the owner of what another browser uploaded. The person who made the link can see, change and delete what you upload from here. Go on only if you made it yourself.',
    ),
    t('I made it myself'),
  );

/** True if the user accepts that this browser may lose the photos it has owned until now. */
export const givesUp = () =>
  ask(
    t('Give up the photos of this browser?'),
    t(
      'Photos were uploaded from this browser already. It could no longer see, change or delete them, and there is no other way back to them.',
    ),
    t('Give them up'),
  );

/**
 * Asks the user; closing the dialog means no.
 * @param {string} title
 * @param {string} text
 * @param {string} yes
 * @returns {Promise<boolean>}
 */
async function ask(title, text, yes) {
  let said = false;
  const agree = button(
    yes,
    () => {
      said = true;
      dialog.close();
    },
    'danger',
  );
  const dialog = await showDialog(title, element('p', '', text), element('div', 'row', agree));
  return new Promise((resolve) => dialog.addEventListener('close', () => resolve(said), { once: true }));
}

// How to put a photo on your own page: in a frame, as an element, or as a page in one file.

import { t } from '../i18n/messages.js';
import { changeSettings, photoUrl } from './api.js';
import { button, copied, showDialog } from './dialog.js';
import { at, element, isLoopback } from './dom.js';
import { snippets } from './snippets.js';

/** @import { Shared } from './dialog.js' */

/**
 * Shows the dialog.
 * @param {Shared} photo
 */
export function open({ id, viewer, name, file, visibility, changed }) {
  const { width, height } = viewer.head ?? { width: 16, height: 10 };
  const code = snippets({ origin: location.origin + at(''), id, name, width, height });
  const page = element('a', 'button', t('Download'));
  page.href = photoUrl(id, '/export?format=html');
  page.download = `${file}.html`;
  const pieces = element(
    'div',
    '',
    ...(isLoopback() ? [element('p', '', t('This address works only on this machine. Others need the server’s name.'))] : []),
    piece(t('In a frame'), t('Needs no script.'), code.frame),
    piece(t('As an element'), t('With attributes, methods and events.'), code.element),
  );
  // do not offer code that would show nothing
  pieces.hidden = visibility === 'private';
  const shown = (/** @type {Parameters<Shared['changed']>[0]} */ answer) => {
    pieces.hidden = false;
    changed(answer);
  };
  return showDialog(
    t('Put it on a page'),
    ...(visibility === 'private' ? [askToShow(id, shown)] : []),
    pieces,
    element(
      'section',
      '',
      element('h3', '', t('As a page in one file')),
      element('p', '', t('Opens from disk, without a server or a network.')),
      element('div', 'row', page),
    ),
  );
}

/**
 * Asks whether everybody with the link may see the photo; otherwise the copied code shows nothing.
 * @param {string} id
 * @param {Shared['changed']} changed
 */
function askToShow(id, changed) {
  const note = element('p', '', t('Only you can see this photo. On a page it is shown once anyone with the link can see it.'));
  const allow = button(t('Let anyone with the link see it'), async () => {
    try {
      changed(await changeSettings(id, { visibility: 'link' }, null));
      section.replaceChildren(element('p', '', t('Anyone with the link can see it.')));
    } catch (error) {
      note.textContent = error.message;
    }
  });
  const section = element('section', '', note, element('div', 'row', allow));
  return section;
}

/**
 * @param {string} title
 * @param {string} note
 * @param {string} code
 */
function piece(title, note, code) {
  return element('section', 'piece', element('h3', '', title), element('p', '', note), ...copied(title, code).parts);
}

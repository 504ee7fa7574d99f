// How to put a photo on a page of one's own: in a frame, as an element, or as a page in one file.

import { t } from '../i18n/messages.js';
import { photoUrl } from './api.js';
import { element } from './dom.js';
import { button, showDialog } from './share-dialog.js';
import { snippets } from './snippets.js';

/** @import { Shared } from './share-dialog.js' */

const COPIED_MS = 2000;

/** True where others cannot reach the server by the page's address. */
const isLoopback = () => /^(localhost|.*\.localhost|127\..*|\[::1\])$/.test(location.hostname);

/**
 * Shows the dialog.
 * @param {Shared} photo
 */
export function open({ id, viewer, name, file }) {
  const { width, height } = viewer.head ?? { width: 16, height: 10 };
  const code = snippets({ origin: location.origin, id, name, width, height });
  const page = element('a', 'button', t('Download'));
  page.href = photoUrl(id, '/export?format=html');
  page.download = `${file}.html`;
  return showDialog(
    t('Put it on a page'),
    ...(isLoopback() ? [element('p', '', t('This address works on this machine alone; others need the server’s own name.'))] : []),
    piece(t('In a frame'), t('Needs no script of yours.'), code.frame),
    piece(t('As an element'), t('With attributes, methods and events.'), code.element),
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
 * @param {string} title
 * @param {string} note
 * @param {string} code
 */
function piece(title, note, code) {
  const text = element('textarea');
  text.readOnly = true;
  text.spellcheck = false;
  text.value = code;
  text.setAttribute('aria-label', title);
  const copy = button(t('Copy'), async () => {
    try {
      await navigator.clipboard.writeText(code);
      say(t('Copied'));
      setTimeout(() => say(t('Copy')), COPIED_MS);
    } catch {
      // no clipboard on a page without TLS: ready for the keyboard's
      text.focus();
      text.select();
    }
  });
  /** @param {string} word */
  function say(word) {
    copy.textContent = word;
    copy.setAttribute('aria-label', `${word}: ${title}`);
  }
  say(t('Copy'));
  return element('section', '', element('h3', '', title), element('p', '', note), text, element('div', 'row', copy));
}

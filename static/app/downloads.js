// The links of the download menu to files that the server renders.

import { t } from '../i18n/messages.js';
import { getPresets, photoUrl } from './api.js';
import { $, element } from './dom.js';

/** @import { Presets } from './api.js' */

/** Pictures that the server renders; the focus distance lies in the screen. */
const PICTURES = /** @type {Record<string, {query: string, ending: string}>} */ ({
  anaglyph: { query: 'stereo=anaglyph&format=jpeg', ending: '-anaglyph.jpg' },
  sbs: { query: 'stereo=sbs&format=jpeg', ending: '-sbs.jpg' },
  mpo: { query: 'stereo=sbs&format=mpo', ending: '.mpo' },
  // columns, rows and aspect are in the file name, where the displays' programs read them
  quilt: { query: 'quilt=8x6&w=420&h=560&format=png', ending: '_qs8x6a0.75.png' },
});

/** @type {Promise<Presets> | undefined} */
let asked;

/**
 * Links to views and films by the server's presets; hides the pictures that it would refuse.
 * @param {string} id of the photo
 * @param {string} stem of the files' names
 */
async function showPresets(id, stem) {
  asked ??= getPresets();
  const { presets, only } = await asked;
  for (const link of document.querySelectorAll(/** @type {'a'} */ ('[data-view]'))) link.hidden = only;
  const links = presets
    .filter(({ kind }) => kind !== 'photo')
    .map(({ name, kind }) => {
      const link = element('a', '', kind === 'film' ? t('A film: {0}', name) : t('A picture: {0}', name));
      link.href = photoUrl(id, `/view?preset=${name}`);
      // browsers add the ending of the file's type to a name without a dot
      link.download = `${stem}-${name}`.replaceAll('.', '-');
      return link;
    });
  $('preset-downloads').replaceChildren(...links);
}

/**
 * Sets addresses and names of the links to pictures and depth, for the photo's current state.
 * @param {string} id of the photo
 * @param {string} stem of the files' names
 * @param {number} focus disparity of what lies in the screen
 */
export function showPictures(id, stem, focus) {
  for (const link of document.querySelectorAll(/** @type {'a'} */ ('[data-view]'))) {
    const { query, ending } = PICTURES[link.dataset.view ?? ''];
    link.href = photoUrl(id, `/view?${query}&focus=${focus.toFixed(3)}`);
    link.download = stem + ending;
  }
  const depth = $('depth-download', HTMLAnchorElement);
  depth.href = photoUrl(id, '/depth');
  depth.download = `${stem}_depth.png`;
  showPresets(id, stem);
}

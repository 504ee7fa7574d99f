// Better depth: offers to fetch a better network, tells how that fares, and has photos of the one before made again.

import { t } from '../i18n/messages.js';
import { formatBytes } from '../i18n/text.js';
import { fetchNetwork, getNetwork, getPhoto, makeAgain } from './api.js';
import { networkName } from './depth-source.js';
import { element } from './dom.js';
import { untilMade } from './follow-photo.js';

/** @import { Network } from './api.js' */

const ASK_EVERY_MS = 500;
/** Answers to those whom the server's networks are no affair of. */
const REFUSALS = [401, 403, 404];

/**
 * Fills `place` with what can be had for a photo whose depth `model` estimated, as its report names it: the server says whether the caller may have it
 * made again, and tells whom they concern of its networks.
 * @param {HTMLElement} place
 * @param {{id: string, model?: string, made: () => void}} photo `made`: called once it was made again
 */
export async function offerBetterDepth(place, { id, model, made }) {
  const estimated = model && model !== 'given' && model !== 'carried';
  if (!estimated) return place.replaceChildren();
  let asking = 0;

  /**
   * @param {Pick<Network, 'better' | 'fetched_bytes' | 'problem'>} network
   * @param {string} [atHand] a better network that the photo can be made again with
   */
  function show({ better, fetched_bytes: bytes, problem }, atHand) {
    if (better && bytes !== undefined) {
      const bar = element('progress');
      bar.setAttribute('aria-label', t('Fetching better depth'));
      if (better.bytes) bar.value = bytes / better.bytes;
      const text = better.bytes ? t('{0} of {1}', formatBytes(bytes), formatBytes(better.bytes)) : formatBytes(bytes);
      place.replaceChildren(element('p', 'hint', `${t('Fetching better depth')}: ${text}`), bar);
      clearTimeout(asking);
      asking = setTimeout(ask, ASK_EVERY_MS);
      return;
    }
    /** @type {HTMLElement[]} */
    const parts = problem ? [failure(problem)] : [];
    if (better) parts.push(button(t('Better depth: {0}, once', better.bytes ? formatBytes(better.bytes) : better.name), fetchIt));
    else if (atHand) parts.push(button(t('Make again with {0}', t(networkName(atHand))), again));
    place.replaceChildren(...parts);
  }

  /** @param {() => Promise<Network>} request */
  async function told(request) {
    try {
      /** @type {Pick<Network, 'better' | 'fetched_bytes' | 'problem'>} */
      const network = await request().catch((error) => {
        // only the server knows who may: this machine's own user, and keys for its affairs from anywhere
        if (REFUSALS.includes(error.status)) return {};
        throw error;
      });
      show(network, network.better ? undefined : (await getPhoto(id)).better_depth);
    } catch (error) {
      place.replaceChildren(element('p', 'hint', error.message), button(t('Try again'), ask));
    }
  }

  const ask = () => told(getNetwork);
  const fetchIt = () => told(fetchNetwork);

  async function again() {
    place.replaceChildren(element('p', 'hint', t('Making the photo again…')));
    try {
      const photo = await makeAgain(id);
      if (photo.state !== 'done') await untilMade(id);
      place.replaceChildren();
      made();
    } catch (error) {
      place.replaceChildren(element('p', 'hint', error.message), button(t('Try again'), ask));
    }
  }

  await ask();
}

/**
 * That the network could not be fetched, and for whoever asks, why.
 * @param {string} problem as the server has it
 */
function failure(problem) {
  const summary = element('summary', '', t('The server could not fetch it. Is it connected to the internet?'));
  return element('details', 'hint', summary, element('p', '', problem));
}

/**
 * @param {string} text
 * @param {() => void} run
 */
function button(text, run) {
  const made = element('button', '', text);
  made.type = 'button';
  made.addEventListener('click', run);
  return made;
}

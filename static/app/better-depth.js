// Better depth: offers to fetch a better network, shows the progress, and makes photos of the old network again.

import { formatBytes } from '../i18n/format.js';
import { t } from '../i18n/messages.js';
import { fetchNetwork, getNetwork, getPhoto, makeAgain } from './api.js';
import { networkName } from './depth-summary.js';
import { element } from './dom.js';
import { untilMade } from './follow-photo.js';

/** @import { Network } from './api.js' */

const ASK_EVERY_MS = 500;
/** Statuses that mean: the caller may not see the server's networks. */
const REFUSALS = [401, 403, 404];

/**
 * Fills `place` with what the server offers for a photo whose depth `model` estimated, as its report names it. The server decides whether
 * the caller may have the photo made again, and who may see its networks.
 * @param {HTMLElement} place
 * @param {{id: string, model?: string, made: () => void}} photo `made`: called after it was made again
 */
export async function offerBetterDepth(place, { id, model, made }) {
  const estimated = model && model !== 'given' && model !== 'embedded';
  if (!estimated) return place.replaceChildren();
  let asking = 0;

  /**
   * @param {Pick<Network, 'better' | 'fetched_bytes' | 'problem'>} network
   * @param {string} [atHand] a better network that the server has already
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
        // only the server knows who may: a local user, or a holder of an admin key
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
 * Says that fetching the network failed, and why on request.
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

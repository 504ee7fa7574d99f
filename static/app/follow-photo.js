// Follows a photo through processing by the server's events, or by polling if those are unavailable.
import { t } from '../i18n/messages.js';
import { getPhoto, photoUrl } from './api.js';

/** @import { Photo } from './api.js' */

const ASK_EVERY_MS = 1500;
const UNKNOWN = 'It could not be made.';

/**
 * Why making a photo failed, from its state.
 * @param {Pick<Photo, 'problem'>} photo
 */
export function reasonOf(photo) {
  return photo.problem?.detail || photo.problem?.title || UNKNOWN;
}

/**
 * True while a photo is queued or in work.
 * @param {Photo} photo
 */
export function isUnderWay(photo) {
  return photo.state === 'queued' || photo.state === 'working';
}

/**
 * Resolves when a photo is made; rejects if that fails.
 * @param {string} id
 * @returns {Promise<void>}
 */
export function untilMade(id) {
  return new Promise((resolve, reject) => {
    const failed = (/** @type {string} */ reason) => reject(new Error(reason));
    followPhoto(id, { queued: () => {}, stage: () => {}, done: resolve, failed, deleted: () => failed(t('The photo was deleted.')) });
  });
}

/**
 * @param {string} id
 * @param {{queued: (position: number) => void, stage: (at: {stage: string, step: number, steps: number}) => void, done: () => void,
 *   failed: (reason: string) => void, deleted: () => void}} on ends with one of `done`, `failed` and `deleted`
 * @returns {() => void} stops following
 */
export function followPhoto(id, on) {
  const source = new EventSource(photoUrl(id, '/events'));
  let timer = 0;
  let ended = false;

  function end() {
    ended = true;
    clearTimeout(timer);
    source.close();
  }

  /** @param {() => void} call */
  function settle(call) {
    if (ended) return;
    end();
    call();
  }

  async function ask() {
    try {
      const photo = await getPhoto(id);
      if (photo.state === 'done') settle(on.done);
      else if (photo.state === 'failed' || photo.state === 'damaged') settle(() => on.failed(reasonOf(photo)));
      else if (!ended && photo.progress) on.stage(photo.progress);
    } catch (error) {
      settle(() => on.failed(error.message));
    }
    if (!ended) timer = setTimeout(ask, ASK_EVERY_MS);
  }

  source.addEventListener('queued', (event) => on.queued(JSON.parse(event.data).position));
  source.addEventListener('stage', (event) => on.stage(JSON.parse(event.data)));
  source.addEventListener('done', () => settle(on.done));
  for (const name of ['failed', 'damaged']) {
    source.addEventListener(name, (event) => settle(() => on.failed(reasonOf({ problem: JSON.parse(event.data) }))));
  }
  source.addEventListener('deleted', () => settle(on.deleted));
  source.onerror = () => {
    // the browser reconnects unless the server refused
    if (source.readyState === EventSource.CLOSED && !ended) ask();
  };
  return end;
}

// Follows a photo on its way by the server's events, and by asking where these cannot be had.
import { getPhoto, photoUrl } from './api.js';

const ASK_EVERY_MS = 1500;

/**
 * @param {string} id
 * @param {{stage: (message: {stage: string, step: number, steps: number}) => void, done: () => void, failed: (message: string) => void}} on
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

  function settle(photo) {
    if (ended || (photo.state !== 'done' && photo.state !== 'failed')) return false;
    end();
    if (photo.state === 'done') on.done();
    else on.failed(photo.error ?? 'It could not be made.');
    return true;
  }

  async function ask() {
    try {
      if (settle(await getPhoto(id))) return;
    } catch (error) {
      if (!ended) {
        end();
        on.failed(error.message);
      }
      return;
    }
    if (!ended) timer = setTimeout(ask, ASK_EVERY_MS);
  }

  source.addEventListener('progress', (event) => on.stage(JSON.parse(event.data)));
  source.addEventListener('done', () => settle({ state: 'done' }));
  source.addEventListener('failed', (event) => settle({ state: 'failed', error: JSON.parse(event.data).detail }));
  source.onerror = () => {
    // the browser tries again by itself unless the server refused
    if (source.readyState === EventSource.CLOSED && !ended) ask();
  };
  return end;
}

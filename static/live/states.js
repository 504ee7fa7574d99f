// What a page says of a room's state, and how far its picture is behind the camera.
import { t } from '../i18n/messages.js';

/** Most that two clocks may be apart for the time behind the camera to be told, ms. */
const CREDIBLE_MS = 20_000;
/** What ends it. */
const FAILURES = new Set(['refused', 'none', 'unsupported']);

/** @typedef {{state: string, reason: string}} Told of its state, and the server's own words where it sent somebody away */

/**
 * What is said where there is no picture, or it stands still; empty where it is live.
 * @param {string} state
 */
function waiting(state) {
  switch (state) {
    case 'connecting':
      return t('Connecting…');
    case 'waiting':
      return t('Nobody is live here yet. The picture starts by itself.');
    case 'full':
      return t('The room is full. This page tries again by itself.');
    case 'ended':
      return t('The live picture has ended. It continues by itself when somebody goes live again.');
    case 'away':
      return t('The server cannot be reached. Trying again…');
    case 'live':
      return t('Loading…');
    case 'stalled':
      return t('The picture is delayed.');
    default:
      return '';
  }
}

/**
 * @param {string} state one of `FAILURES`
 * @param {string} reason
 */
function failure(state, reason) {
  switch (state) {
    case 'refused':
      return t('To watch this room you need a link that is still valid. Ask the person who sent you the link for a new one.');
    case 'none':
      return t('There is no such room on this server.');
    default:
      return reason
        ? t('This browser cannot show the video of this room: {0}', reason)
        : t('This browser cannot decode the video of this room.');
  }
}

/**
 * What to say of a state, and whether it is over.
 * @param {Told} told
 * @returns {{over: boolean, text: string}}
 */
export function saying({ state, reason }) {
  if (FAILURES.has(state)) return { over: true, text: failure(state, reason) };
  if (state === 'ended' && reason)
    return { over: false, text: t('The live picture has ended: {0}. It continues by itself when somebody goes live again.', reason) };
  if (reason) return { over: true, text: t('The server says: {0}', reason) };
  return { over: false, text: waiting(state) };
}

/**
 * How far the picture is behind the camera, ms: by the clocks of both where these agree, else what it lost on its way.
 * @param {{latency: number, lag: number}} told
 */
export function behind({ latency, lag }) {
  return latency > 0 && latency < CREDIBLE_MS ? latency : lag;
}

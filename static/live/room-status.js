// Status texts of a room, and the delay of its picture.
import { t } from '../i18n/messages.js';

/** Largest latency that is believed, ms: beyond it, the clocks of publisher and viewer disagree. */
const CREDIBLE_MS = 20_000;
/** States that are final. */
const FAILURES = new Set(['refused', 'none', 'unsupported']);

/** @typedef {{state: string, reason: string}} RoomState `reason`: the server's text if it disconnected somebody */

/**
 * Text shown while the picture is missing or frozen; empty if the room is live.
 * @param {string} state
 */
function waitingText(state) {
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
function failureText(state, reason) {
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
 * The text for a state, and whether the room is over for this page.
 * @param {RoomState} room
 * @returns {{over: boolean, text: string}}
 */
export function statusText({ state, reason }) {
  if (FAILURES.has(state)) return { over: true, text: failureText(state, reason) };
  if (state === 'ended' && reason)
    return { over: false, text: t('The live picture has ended: {0}. It continues by itself when somebody goes live again.', reason) };
  if (reason) return { over: true, text: t('The server says: {0}', reason) };
  return { over: false, text: waitingText(state) };
}

/**
 * Delay of the picture, ms: its latency from the camera if the clocks of both ends agree, otherwise how much frames lag behind the fastest one.
 * @param {{latency: number, lag: number}} measured
 */
export function pictureDelay({ latency, lag }) {
  return latency > 0 && latency < CREDIBLE_MS ? latency : lag;
}

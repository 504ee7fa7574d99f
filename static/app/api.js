// The server's HTTP interface, as far as the pages need it.
import { problemText } from '../decode/problem.js';
import { linkOf, withLink } from '../element/link.js';
import { t } from '../i18n/messages.js';
import { formatBytes } from '../i18n/text.js';

/** @import { Settings } from '../view/settings.js' */
/** @import { Stroke } from './outline.js' */

/**
 * State of a photo as the server tells it.
 * @typedef {object} Photo
 * @property {string} [version] names the bytes of all that is made of it, once it is done
 * @property {string} id
 * @property {'queued' | 'working' | 'done' | 'failed' | 'damaged'} state
 * @property {string} created
 * @property {string} [better_depth] a network that is at hand and better than the one that estimated its depth, for whoever may have it made again
 * @property {'private' | 'link'} [visibility] who may see it, where the server asks who comes
 * @property {number} width
 * @property {number} height
 * @property {number} atlas_bytes size of the container
 * @property {Settings} [settings]
 * @property {{atlas: string, poster: string}} links
 * @property {{stage: string, step: number, steps: number}} [progress]
 * @property {{title?: string, detail?: string}} [problem]
 */

/**
 * What a refusal says for people: what programs are told in numbers and tags, in words.
 * @param {number} status
 * @param {string} statusText
 * @param {string} body
 */
export function wordsOf(status, statusText, body) {
  const text = problemText(status, statusText, body);
  const limit = /over the limit of (\d+) (bytes|pixels)/.exec(text);
  if (limit?.[2] === 'bytes') return t('The file is too large: at most {0} can be sent.', formatBytes(Number(limit[1])));
  if (limit) return t('The photo has too many pixels: at most {0} million can be made.', Math.floor(Number(limit[1]) / 1e6));
  if (status === 412) return t('Somebody changed the photo in the meantime. Reload the page to see the change.');
  return text;
}

/**
 * An answer of the server; an error has the `status` of a refusal.
 * @param {string} url
 * @param {RequestInit} [options]
 */
async function request(url, options) {
  let response;
  try {
    response = await fetch(url, options);
  } catch {
    throw new Error('The server cannot be reached.');
  }
  if (!response.ok) {
    const words = wordsOf(response.status, response.statusText, await response.text().catch(() => ''));
    throw Object.assign(new Error(words), { status: response.status });
  }
  return response;
}

/** The link by which the page was opened: not every browser keeps its cookie. */
const LINK = linkOf(globalThis.location?.search);

export const photoUrl = (/** @type {string} */ id, part = '') => withLink(`/v1/photos/${encodeURIComponent(id)}${part}`, LINK);

/**
 * One page of the list, newest first: `{photos, next}`; `next` is the address of the next page.
 * @param {string} [address]
 * @returns {Promise<{photos: Photo[], next?: string}>}
 */
export async function listPhotos(address = '/v1/photos') {
  return (await request(address)).json();
}

/**
 * State of one photo.
 * @param {string} id
 * @returns {Promise<Photo>}
 */
export async function getPhoto(id) {
  return (await request(photoUrl(id))).json();
}

/**
 * Changes settings of a photo by a merge patch; only the version `etag`, where it is given.
 * @param {string} id
 * @param {object} patch
 * @param {string | null} etag
 * @returns {Promise<{state: Photo, etag: string | null}>}
 */
export async function changeSettings(id, patch, etag) {
  const headers = { 'content-type': 'application/merge-patch+json', ...(etag && { 'if-match': etag }) };
  const response = await request(photoUrl(id), { method: 'PATCH', headers, body: JSON.stringify(patch) });
  return { state: await response.json(), etag: response.headers.get('etag') };
}

/**
 * Pages of a photo for others: `page` is good until `expires`, in seconds since 1970; `manage` lets somebody change it until that is taken back. And
 * where this browser makes tickets by which another one becomes the same owner, if it can.
 * @typedef {{page: string, expires?: number, manage?: string, ticket?: string}} PhotoLinks
 */

/**
 * Links to a photo that are good for `seconds`.
 * @param {string} id
 * @param {number} seconds
 * @returns {Promise<PhotoLinks>}
 */
export async function linksOf(id, seconds) {
  return (await request(photoUrl(id, `/links?seconds=${seconds}`), { method: 'POST' })).json();
}

/**
 * A ticket by which another browser becomes the owner that this one is; it soon ends.
 * @returns {Promise<string>}
 */
export async function ownerTicket() {
  return (await (await request('/v1/owner/ticket', { method: 'POST' })).json()).ticket;
}

/**
 * Takes back all links to a photo.
 * @param {string} id
 */
export async function takeLinksBack(id) {
  await request(photoUrl(id, '/manage'), { method: 'DELETE' });
}

/** Longest that the server is asked to wait for a photo that it makes again; then its events are followed. */
const WAIT_S = 20;

/**
 * The strokes of a photo's touch-up, and their version.
 * @param {string} id
 * @returns {Promise<{strokes: Stroke[], etag: string | null}>}
 */
export async function strokesOf(id) {
  const response = await request(photoUrl(id, '/strokes'));
  return { strokes: (await response.json()).strokes, etag: response.headers.get('etag') };
}

/**
 * Gives a photo other strokes, if it still has those of version `etag`: it is made again, and done or under way then.
 * @param {string} id
 * @param {Stroke[]} strokes
 * @param {string | null} etag
 * @returns {Promise<Photo>}
 */
export async function changeStrokes(id, strokes, etag) {
  const headers = { 'content-type': 'application/merge-patch+json', prefer: `wait=${WAIT_S}`, ...(etag && { 'if-match': etag }) };
  return (await request(photoUrl(id, '/strokes'), { method: 'PATCH', headers, body: JSON.stringify({ strokes }) })).json();
}

/**
 * The server's depth network, the kinds that it is better than, and the better one that it may fetch.
 * @typedef {{name: string, better_than: string[], better?: {name: string, bytes?: number}, fetched_bytes?: number, problem?: string}} Network
 */

/** @returns {Promise<Network>} */
export async function getNetwork() {
  return (await request('/v1/network')).json();
}

/** @returns {Promise<Network>} */
export async function fetchNetwork() {
  return (await request('/v1/network', { method: 'POST' })).json();
}

/**
 * Has a photo made again: done or under way then.
 * @param {string} id
 * @returns {Promise<Photo>}
 */
export async function makeAgain(id) {
  return (await request(photoUrl(id, '/again'), { method: 'POST', headers: { prefer: `wait=${WAIT_S}` } })).json();
}

/**
 * `options.keepalive`: goes on when the page is left.
 * @param {string} id
 * @param {RequestInit} [options]
 */
export async function deletePhoto(id, options = {}) {
  await request(photoUrl(id), { method: 'DELETE', ...options });
}

// The server's HTTP interface, as far as the pages need it.
import { problemText } from '../decode/problem.js';
import { linkOf, withLink } from '../element/signed-link.js';
import { formatBytes } from '../i18n/format.js';
import { t } from '../i18n/messages.js';
import { at } from './dom.js';

/** @import { Settings } from '../view/settings.js' */
/** @import { Stroke } from './stroke-region.js' */

/**
 * State of a photo as the server returns it.
 * @typedef {object} Photo
 * @property {string} [version] version of the photo's files, once it is done
 * @property {string} id
 * @property {'queued' | 'working' | 'done' | 'failed' | 'damaged'} state
 * @property {string} created
 * @property {string} [better_depth] a better network than the one that estimated the depth, if the caller may have the photo made again
 * @property {'private' | 'link'} [visibility] who may see it, on a server with access control
 * @property {number} width
 * @property {number} height
 * @property {number} atlas_bytes size of the container
 * @property {Settings} [settings]
 * @property {{atlas: string, poster: string}} links
 * @property {{stage: string, step: number, steps: number}} [progress]
 * @property {{title?: string, detail?: string}} [problem]
 */

/**
 * A refusal in words for people, in place of the numbers and tags for programs.
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

/** The link with which the page was opened: some browsers do not keep its cookie. */
const LINK = linkOf(globalThis.location?.search);

export const photoUrl = (/** @type {string} */ id, part = '') => withLink(at(`/v1/photos/${encodeURIComponent(id)}${part}`), LINK);

/**
 * One page of the list, newest first: `{photos, next}`; `next` is the address of the next page.
 * @param {string} [address]
 * @returns {Promise<{photos: Photo[], next?: string}>}
 */
export async function listPhotos(address = at('/v1/photos')) {
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
 * Changes settings of a photo by a merge patch. With `etag`, only if the settings still have that version.
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
 * Pages of a photo for others: `page` is valid until `expires`, in seconds since 1970; `manage` lets others change it until it is revoked.
 * `ticket` is the route that issues tickets for another browser, if this browser may have any.
 * @typedef {{page: string, expires?: number, manage?: string, ticket?: string}} PhotoLinks
 */

/**
 * Links to a photo that are valid for `seconds`.
 * @param {string} id
 * @param {number} seconds
 * @returns {Promise<PhotoLinks>}
 */
export async function linksOf(id, seconds) {
  return (await request(photoUrl(id, `/links?seconds=${seconds}`), { method: 'POST' })).json();
}

/**
 * A ticket that makes another browser the same owner as this one; it expires soon.
 * @returns {Promise<string>}
 */
export async function ownerTicket() {
  return (await (await request(at('/v1/owner/ticket'), { method: 'POST' })).json()).ticket;
}

/**
 * Revokes all links to a photo.
 * @param {string} id
 */
export async function takeLinksBack(id) {
  await request(photoUrl(id, '/manage'), { method: 'DELETE' });
}

/** Maximum seconds of one request that makes a photo again; after that the page follows its events. */
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
 * Changes a photo's strokes if they still have version `etag`. The server makes the photo again: it is done or under way then.
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
 * The server's depth network, the kinds that it is better than, and a better one that it may fetch.
 * @typedef {{name: string, better_than: string[], better?: {name: string, bytes?: number}, fetched_bytes?: number, problem?: string}} Network
 */

/** @returns {Promise<Network>} */
export async function getNetwork() {
  return (await request(at('/v1/network'))).json();
}

/** @returns {Promise<Network>} */
export async function fetchNetwork() {
  return (await request(at('/v1/network'), { method: 'POST' })).json();
}

/**
 * The server's presets, and whether it refuses other options from this browser.
 * @typedef {{presets: {name: string, kind: 'photo' | 'view' | 'film'}[], only: boolean}} Presets
 */

/**
 * The server's presets; none if it does not tell.
 * @returns {Promise<Presets>}
 */
export async function getPresets() {
  try {
    return await (await request(at('/v1/presets'))).json();
  } catch {
    return { presets: [], only: false };
  }
}

/**
 * Makes a photo again; it is done or under way then.
 * @param {string} id
 * @returns {Promise<Photo>}
 */
export async function makeAgain(id) {
  return (await request(photoUrl(id, '/remake'), { method: 'POST', headers: { prefer: `wait=${WAIT_S}` } })).json();
}

/**
 * With `options.keepalive` the request outlives the page.
 * @param {string} id
 * @param {RequestInit} [options]
 */
export async function deletePhoto(id, options = {}) {
  await request(photoUrl(id), { method: 'DELETE', ...options });
}

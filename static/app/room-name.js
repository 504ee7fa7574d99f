// The room of a page, and the token in its address: behind the #, which browsers do not send.

import { at } from './dom.js';

/** Key of the token in the address. */
const KEY = 'token';

/** @typedef {{name: string, address: string, token: string}} RoomOf its name, its address on the server, and the token, '' without one */

/** @returns {RoomOf} */
export function roomOf() {
  const token = new URLSearchParams(location.hash.slice(1)).get(KEY) ?? '';
  // the server answers without its base path, too
  const name = /\/live\/([^/]+)(?:\/publish)?\/?$/.exec(location.pathname)?.[1] ?? '';
  return roomNamed(decodeURIComponent(name), token);
}

/**
 * The room of a name.
 * @param {string} name
 * @param {string} [token]
 * @returns {RoomOf}
 */
export function roomNamed(name, token = '') {
  return { name, address: new URL(at(`/v1/live/${encodeURIComponent(name)}`), location.href).href, token };
}

const CONSONANTS = 'bdfgklmnprstvz';
const VOWELS = 'aeiou';
const SYLLABLES = 4;

/** A random room name that can be said aloud, one of 24 million. */
export function freshName() {
  const random = crypto.getRandomValues(new Uint32Array(SYLLABLES));
  const syllable = (/** @type {number} */ n) =>
    CONSONANTS[n % CONSONANTS.length] + VOWELS[Math.floor(n / CONSONANTS.length) % VOWELS.length];
  return [...random].map(syllable).join('');
}

/**
 * Address of a room's publishing page.
 * @param {string} name
 */
export const publishPage = (name) => at(`/live/${encodeURIComponent(name)}/publish`);

/**
 * Address of a room's page.
 * @param {string} name
 * @param {string | null} token
 */
export function linkTo(name, token) {
  const url = new URL(at(`/live/${encodeURIComponent(name)}`), location.href);
  url.hash = token ? new URLSearchParams({ [KEY]: token }).toString() : '';
  return url.href;
}

// Which room a page is of, and the token that its address brings along: behind the #, which browsers send to nobody.

/** Key of the token in the address. */
const KEY = 'token';

/** @typedef {{name: string, address: string, token: string}} RoomOf its name, where the server has it, and the token, empty without one */

/** @returns {RoomOf} */
export function roomOf() {
  const name = decodeURIComponent(location.pathname.split('/')[2] ?? '');
  const token = new URLSearchParams(location.hash.slice(1)).get(KEY) ?? '';
  return { name, address: new URL(`/v1/live/${encodeURIComponent(name)}`, location.href).href, token };
}

/**
 * Address of a room's page.
 * @param {string} name
 * @param {string | null} token
 */
export function linkTo(name, token) {
  const url = new URL(`/live/${encodeURIComponent(name)}`, location.href);
  url.hash = token ? new URLSearchParams({ [KEY]: token }).toString() : '';
  return url.href;
}

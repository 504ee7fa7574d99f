// Parses the address of a room. The token is best put behind the #, which browsers never send.

/** Key of the token in an address. */
const KEY = 'token';

/**
 * Parses the address of a room's page (`…/live/NAME`) or of the room itself (`…/v1/live/NAME`).
 * @param {string} text
 * @param {string | null} [given] token that is given separately
 * @returns {{name: string, address: string, token: string}} `address`: the room's resource on the server; `token`: empty if there is none
 */
export function roomAt(text, given) {
  const url = new URL(text);
  const token = given || new URLSearchParams(url.hash.slice(1)).get(KEY) || url.searchParams.get(KEY) || '';
  const [, before, name] = url.pathname.match(/^(.*?)(?:\/v1)?\/live\/([^/]*)\/?$/) ?? ['', '', ''];
  [url.pathname, url.search, url.hash] = [`${before}/v1/live/${name}`, '', ''];
  return { name: decodeURIComponent(name), address: url.href, token };
}

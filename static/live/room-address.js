// Which room an address is of, and the token that it brings along: best behind the #, which browsers send to nobody.

/** Key of the token in an address. */
const KEY = 'token';

/**
 * Of a room's page (`…/live/NAME`), or of the room itself (`…/v1/live/NAME`).
 * @param {string} text
 * @param {string | null} [given] a token that stands beside it
 * @returns {{name: string, address: string, token: string}} the room's name, where the server has it, and the token, empty without one
 */
export function roomAt(text, given) {
  const url = new URL(text);
  const token = given || new URLSearchParams(url.hash.slice(1)).get(KEY) || url.searchParams.get(KEY) || '';
  const [, before, name] = url.pathname.match(/^(.*?)(?:\/v1)?\/live\/([^/]*)\/?$/) ?? ['', '', ''];
  [url.pathname, url.search, url.hash] = [`${before}/v1/live/${name}`, '', ''];
  return { name: decodeURIComponent(name), address: url.href, token };
}

// The parameters of a link by which one photo can be seen for a while. They go for every address of the photo, and are told again at each: a frame on
// another site has no cookies.

/**
 * Those in a query, as `expires=…&signature=…`; empty where there are none.
 * @param {string} [query]
 */
export function linkOf(query) {
  const all = new URLSearchParams(query);
  const [expires, signature] = [all.get('expires'), all.get('signature')];
  return expires && signature ? `${new URLSearchParams({ expires, signature })}` : '';
}

/**
 * An address with them.
 * @param {string} address
 * @param {string} link
 */
export function withLink(address, link) {
  return link ? `${address}${address.includes('?') ? '&' : '?'}${link}` : address;
}

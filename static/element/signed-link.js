// The parameters of a link that lets one photo be seen for a while. They are valid for all addresses of the photo, and each request carries
// them: a frame on another site has no cookies.

/**
 * The link's parameters of a query, as `expires=…&signature=…`, after `key=…` if an application signed it; '' without them.
 * @param {string} [query]
 */
export function linkOf(query) {
  const all = new URLSearchParams(query);
  const [key, expires, signature] = ['key', 'expires', 'signature'].map((name) => all.get(name));
  return expires && signature ? `${new URLSearchParams({ ...(key && { key }), expires, signature })}` : '';
}

/**
 * An address with them.
 * @param {string} address
 * @param {string} link
 */
export function withLink(address, link) {
  return link ? `${address}${address.includes('?') ? '&' : '?'}${link}` : address;
}

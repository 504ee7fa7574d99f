// A link with `#manage=` lets this browser change its one photo. A link with `#owner=` makes this browser another owner after a
// confirmation: later uploads belong to the link's maker. The secret is removed from the address and comes back as a cookie that scripts
// cannot read.

import { at } from './dom.js';

const [, kind, secret] = /^#(manage|owner)=(tmpi_[mot]_[\w-]+)$/.exec(location.hash) ?? [];
if (secret) {
  history.replaceState(history.state, '', location.pathname + location.search);
  const post = (/** @type {string} */ address) =>
    fetch(at(address), { method: 'POST', headers: { authorization: `Bearer ${secret}` } }).catch(() => null);
  // if the cookie cannot be kept, the page shows what everybody may see
  if (kind === 'manage') await post(`/v1/photos/${location.pathname.split('/').filter(Boolean).pop()}/manage`);
  else {
    const { isMine, givesUp } = await import('./owner-dialog.js');
    if ((await isMine()) && (await post('/v1/owner'))?.status === 409 && (await givesUp())) await post('/v1/owner?replace=true');
  }
}

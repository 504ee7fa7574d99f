// A link with `#manage=` lets this browser change its one photo. A link with `#owner=` makes this browser another owner, once somebody says so: what
// it uploads from then on belongs to whoever made the link. What is secret leaves the address, and comes back as a cookie that no script reads.

// a module: what it awaits is there before the page begins
export {};

const [, kind, secret] = /^#(manage|owner)=(tmpi_[mot]_[\w-]+)$/.exec(location.hash) ?? [];
if (secret) {
  history.replaceState(history.state, '', location.pathname + location.search);
  const post = (/** @type {string} */ address) =>
    fetch(address, { method: 'POST', headers: { authorization: `Bearer ${secret}` } }).catch(() => null);
  // where it cannot be kept, the page says of the photo what it says to everybody
  if (kind === 'manage') await post(`/v1/photos/${location.pathname.split('/').filter(Boolean).pop()}/manage`);
  else {
    const { isMine, givesUp } = await import('./owner-dialog.js');
    if ((await isMine()) && (await post('/v1/owner'))?.status === 409 && (await givesUp())) await post('/v1/owner?replace=true');
  }
}

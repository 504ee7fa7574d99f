// A link with `#owner=` makes this browser the owner: the secret leaves the address, and comes back as a cookie that no script reads.

// a module: what it awaits is there before the page begins
export {};

const secret = /^#owner=(tmpi_o_[\w-]+)$/.exec(location.hash)?.[1];
if (secret) {
  history.replaceState(history.state, '', location.pathname + location.search);
  // where it cannot be kept, the page says of the photo what it says to everybody
  await fetch('/v1/owner', { method: 'POST', headers: { authorization: `Bearer ${secret}` } }).catch(() => {});
}

// Starts workers off the page's thread.

/** A worker that runs worker.js. */
export function startDecoder() {
  return startWorker(new URL('./worker.js', import.meta.url));
}

/**
 * A worker that runs a module, of another origin, too.
 * @param {URL} url
 */
export function startWorker(url) {
  if (url.protocol === 'data:' || url.origin === location.origin) return new Worker(url, { type: 'module' });
  // a worker's script must be of the page's own origin; what it imports need not
  const address = URL.createObjectURL(new Blob([`import ${JSON.stringify(url.href)};`], { type: 'text/javascript' }));
  const worker = new Worker(address, { type: 'module' });
  // by its first message it has long been read
  const forget = () => URL.revokeObjectURL(address);
  worker.addEventListener('message', forget, { once: true });
  worker.addEventListener('error', forget, { once: true });
  return worker;
}

// Starts the decoder off the page's thread.

/** A worker that runs decode-worker.js. */
export function startDecoder() {
  return new Worker(workerAddress(), { type: 'module' });
}

/** A worker's script must be of the page's own origin; what it imports need not. */
function workerAddress() {
  const url = new URL('./decode-worker.js', import.meta.url);
  if (url.protocol === 'data:' || url.origin === location.origin) return url;
  return URL.createObjectURL(new Blob([`import ${JSON.stringify(url.href)};`], { type: 'text/javascript' }));
}

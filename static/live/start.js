// Starts watching a room off the page's thread.

/** A worker that runs worker.js. */
export function startRoom() {
  return new Worker(new URL('./worker.js', import.meta.url), { type: 'module' });
}

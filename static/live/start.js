// Starts watching a room off the page's thread.
import { startWorker } from '../decode/start.js';

/** A worker that runs worker.js. */
export function startRoom() {
  return startWorker(new URL('./worker.js', import.meta.url));
}

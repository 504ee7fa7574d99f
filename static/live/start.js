// Starts the worker that watches a room.
import { startWorker } from '../decode/start.js';

/** Starts a worker that runs worker.js. */
export function startRoom() {
  return startWorker(new URL('./worker.js', import.meta.url));
}

// Starts the decoder in a worker, or on the page's thread if workers are not available.

/** Name of the Trusted Types policy for the workers' addresses. */
const POLICY = 'tmpi';
/** @type {{createScriptURL: (address: string) => string} | null | undefined} */
let policy;

/**
 * A worker's address in the form that Trusted Types require.
 * @param {string} address
 */
function trusted(address) {
  if (policy === undefined) {
    try {
      const createScriptURL = (/** @type {string} */ own) => own;
      policy = /** @type {any} */ (self).trustedTypes?.createPolicy(POLICY, { createScriptURL }) ?? null;
    } catch {
      // the page does not allow the policy, so it gets no workers
      policy = null;
    }
  }
  return policy ? policy.createScriptURL(address) : address;
}

/**
 * Starts a worker that runs a module, even from another origin. Throws if the page does not allow workers.
 * @param {URL} url
 */
export function startWorker(url) {
  // compare self.origin, because a sandboxed frame has none, whatever its address
  if (url.protocol === 'data:' || url.origin === self.origin) return new Worker(trusted(url.href), { type: 'module' });
  const module = JSON.stringify(url.href);
  // a worker's script must have the page's origin, but its imports need not; a page without an origin cannot start module workers
  const isModule = self.origin !== 'null';
  const early = 'const early = []; self.onmessage = (event) => early.push(event);';
  const begin = '() => early.forEach((event) => self.onmessage(event)), (error) => setTimeout(() => { throw error; })';
  const text = isModule ? `import ${module};` : `${early} import(${module}).then(${begin});`;
  const address = URL.createObjectURL(new Blob([text], { type: 'text/javascript' }));
  const worker = new Worker(trusted(address), isModule ? { type: 'module' } : {});
  // its first message or error proves that the script is loaded
  const forget = () => URL.revokeObjectURL(address);
  worker.addEventListener('message', forget, { once: true });
  worker.addEventListener('error', forget, { once: true });
  return worker;
}

/** Runs load.js in a worker, or on the page's thread if no worker can start; has the interface of a worker. */
export class Decoder {
  /** @type {((event: MessageEvent) => void) | null} */
  onmessage = null;
  /** @type {((event: {message: string}) => void) | null} */
  onerror = null;
  /** @type {Worker | null} */
  #worker = null;
  /** @type {MessagePort | null} */
  #port = null;
  /** Requests without an answer yet. @type {object[]} */
  #asked = [];
  #over = false;

  constructor() {
    try {
      this.#worker = startWorker(new URL('./worker.js', import.meta.url));
      this.#worker.onmessage = (event) => this.#hear(event);
      this.#worker.onerror = (event) => {
        if (!this.#asked.length) return this.onerror?.(event);
        // the worker failed to start
        event.preventDefault();
        this.#stay();
      };
    } catch {
      this.#stay();
    }
  }

  /**
   * Requests a container (load.js).
   * @param {object} message
   * @param {Transferable[]} transfer
   */
  postMessage(message, transfer = []) {
    this.#asked.push(message);
    (this.#worker ?? this.#port)?.postMessage(message, transfer);
  }

  /** @param {MessageEvent} event */
  #hear(event) {
    this.#asked = [];
    if (!this.#over) this.onmessage?.(event);
  }

  /** Decodes on the page's thread, which blocks the page meanwhile. */
  async #stay() {
    this.#worker?.terminate();
    this.#worker = null;
    try {
      const { serve } = await import('./load.js');
      if (this.#over) return;
      const { port1, port2 } = new MessageChannel();
      serve(port2, { alone: true });
      this.#port = port1;
      port1.onmessage = (event) => this.#hear(event);
      for (const message of this.#asked) port1.postMessage(message);
    } catch (error) {
      this.onerror?.({ message: `The decoder could not be started: ${error.message}` });
    }
  }

  terminate() {
    this.#over = true;
    this.#worker?.terminate();
    this.#port?.close();
  }
}

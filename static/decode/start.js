// Starts what decodes a container: off the page's thread, or where no worker can be had on it.

/** Name of the policy by which a page with Trusted Types takes the workers' addresses. */
const POLICY = 'tmpi';
/** @type {{createScriptURL: (address: string) => string} | null | undefined} */
let policy;

/**
 * An address as a worker's is taken where the page has Trusted Types.
 * @param {string} address
 */
function trusted(address) {
  if (policy === undefined) {
    try {
      const createScriptURL = (/** @type {string} */ own) => own;
      policy = /** @type {any} */ (self).trustedTypes?.createPolicy(POLICY, { createScriptURL }) ?? null;
    } catch {
      // the page allows no such policy: it has no worker then
      policy = null;
    }
  }
  return policy ? policy.createScriptURL(address) : address;
}

/**
 * A worker that runs a module, of another origin, too. Throws where the page may have none.
 * @param {URL} url
 */
export function startWorker(url) {
  // a sandboxed frame has no origin, whatever its address
  if (url.protocol === 'data:' || url.origin === self.origin) return new Worker(trusted(url.href), { type: 'module' });
  const module = JSON.stringify(url.href);
  // a worker's script must be of the page's own origin; what it imports need not. Without an origin it can be no module
  const isModule = self.origin !== 'null';
  const early = 'const early = []; self.onmessage = (event) => early.push(event);';
  const begin = '() => early.forEach((event) => self.onmessage(event)), (error) => setTimeout(() => { throw error; })';
  // with a space: what links modules into one script (src/export/script.rs) takes it for text then
  const text = isModule ? `import ${module};` : `${early} import (${module}).then(${begin});`;
  const address = URL.createObjectURL(new Blob([text], { type: 'text/javascript' }));
  const worker = new Worker(trusted(address), isModule ? { type: 'module' } : {});
  // by its first message it has long been read
  const forget = () => URL.revokeObjectURL(address);
  worker.addEventListener('message', forget, { once: true });
  worker.addEventListener('error', forget, { once: true });
  return worker;
}

/** What runs load.js, used as a worker is: in a worker, or on the page's thread where none can be started. */
export class Decoder {
  /** @type {((event: MessageEvent) => void) | null} */
  onmessage = null;
  /** @type {((event: {message: string}) => void) | null} */
  onerror = null;
  /** @type {Worker | null} */
  #worker = null;
  /** @type {MessagePort | null} */
  #port = null;
  /** What was asked and not answered yet. @type {object[]} */
  #asked = [];
  #over = false;

  constructor() {
    try {
      this.#worker = startWorker(new URL('./worker.js', import.meta.url));
      this.#worker.onmessage = (event) => this.#hear(event);
      this.#worker.onerror = (event) => {
        if (!this.#asked.length) return this.onerror?.(event);
        // it never began
        event.preventDefault();
        this.#stay();
      };
    } catch {
      this.#stay();
    }
  }

  /**
   * Asks for a container (load.js).
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

  /** Decodes on the page's own thread: it stands still for as long, but shows the photo in three dimensions. */
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

// A large upload in parts, which goes on by itself where the connection was lost: draft-ietf-httpbis-resumable-upload.

/** @import { Photo } from './api.js' */

/** Files from this size on are sent so, bytes: smaller ones are sent again in a moment. */
export const LARGE_BYTES = 4 * 2 ** 20;
/** Pauses before the server is tried again, s; the last one from then on. */
const PAUSES_S = [1, 2, 4, 8, 15];
/** How long it is tried though nothing more arrives, ms. */
const PATIENCE_MS = 10 * 60_000;

/** The connection was lost, or somebody between here and the server says that it cannot be reached. */
class Lost extends Error {}
/** The server takes no parts. */
export class NoParts extends Error {}

/**
 * How an upload goes: `share` of its bytes that are sent; `waits`, in seconds, where it goes on only after a pause, because the connection was
 * lost or the server is busy.
 * @typedef {(share: number, waits?: {seconds: number, lost: boolean}) => void} Progress
 */

/**
 * Sends a form. `refusal` makes an error of an answer, with `retryAfter` where the server is only busy.
 * @param {FormData} form
 * @param {(xhr: XMLHttpRequest) => Error & {retryAfter?: number}} refusal
 * @param {Progress} onProgress
 * @returns {{done: Promise<Photo>, abort: () => void}}
 */
export function sendInParts(form, refusal, onProgress) {
  const cancelled = new AbortController();
  let address = '';
  const done = send();
  const abort = () => {
    cancelled.abort();
    // what is there of it goes; else it would when its time is over
    if (address) fetch(address, { method: 'DELETE', keepalive: true }).catch(() => {});
  };
  return { done, abort };

  async function send() {
    const whole = new Response(form);
    // the type of a Blob is in small letters, and would name another boundary
    const type = whole.headers.get('content-type') ?? '';
    const body = await whole.blob();
    const begun = await answered(
      ask('POST', '/v1/photos', { 'content-type': type, 'upload-complete': '?0', 'upload-length': String(body.size) }),
    );
    address = begun.getResponseHeader('location') ?? '';
    if (begun.status !== 201 || !address) throw new Error('The server gave an answer that is none to a part.');
    let offset = 0;
    let tries = 0;
    let since = Date.now();
    for (;;) {
      try {
        if (tries) {
          const now = await whereItIs();
          if (now.photo) return await photoAt(now.photo);
          if (now.offset > offset) [tries, since] = [0, Date.now()];
          offset = now.offset;
        }
        onProgress(offset / body.size);
        return json(
          await answered(
            ask('PATCH', address, part(offset), body.slice(offset), (bytes) => onProgress(Math.min(1, (offset + bytes) / body.size))),
          ),
        );
      } catch (error) {
        const lost = error instanceof Lost;
        if (!lost && !error.retryAfter) throw error;
        if (Date.now() - since > PATIENCE_MS) throw lost ? new Error('The server cannot be reached.') : error;
        const seconds = error.retryAfter ?? PAUSES_S[Math.min(tries, PAUSES_S.length - 1)];
        tries++;
        onProgress(offset / body.size, { seconds, lost });
        await pause(seconds * 1000, lost);
      }
    }
  }

  /** @param {number} offset */
  function part(offset) {
    return { 'content-type': 'application/partial-upload', 'upload-offset': String(offset), 'upload-complete': '?1' };
  }

  /** How much the server has, or the address of the photo where it has all. */
  async function whereItIs() {
    const { offset, photo } = json(await answered(ask('GET', address)));
    return /** @type {{offset: number, photo?: string}} */ ({ offset, photo });
  }

  /** @param {string} at */
  async function photoAt(at) {
    return /** @type {Photo} */ (json(await answered(ask('GET', at))));
  }

  /**
   * A request by XMLHttpRequest: it alone tells how much of a body went out.
   * @param {string} method
   * @param {string} url
   * @param {Record<string, string>} [headers]
   * @param {Blob} [body]
   * @param {(bytes: number) => void} [onSent]
   * @returns {Promise<XMLHttpRequest>}
   */
  function ask(method, url, headers = {}, body = undefined, onSent = undefined) {
    return new Promise((resolve, reject) => {
      const stop = () => reject(new DOMException('Cancelled.', 'AbortError'));
      if (cancelled.signal.aborted) return stop();
      const xhr = new XMLHttpRequest();
      cancelled.signal.addEventListener('abort', () => xhr.abort(), { once: true });
      if (onSent) xhr.upload.onprogress = (event) => onSent(event.loaded);
      xhr.onload = () => resolve(xhr);
      xhr.onerror = () => reject(new Lost());
      xhr.onabort = stop;
      xhr.open(method, url);
      xhr.setRequestHeader('Accept', 'application/json');
      for (const [name, value] of Object.entries(headers)) xhr.setRequestHeader(name, value);
      xhr.send(body);
    });
  }

  /**
   * The answer, where it is none that refuses.
   * @param {Promise<XMLHttpRequest>} asked
   */
  async function answered(asked) {
    const xhr = await asked;
    if (xhr.status >= 200 && xhr.status < 300) return xhr;
    // another byte is next, or the request before is still at it; or a proxy that does not reach the server
    if ([408, 409, 423, 502, 504].includes(xhr.status)) throw new Lost();
    if (xhr.status === 501) throw new NoParts();
    throw refusal(xhr);
  }

  /**
   * Waits, but no longer than until there is a network again.
   * @param {number} ms
   * @param {boolean} lost
   */
  function pause(ms, lost) {
    return new Promise((resolve, reject) => {
      const over = new AbortController();
      const timer = setTimeout(() => end(resolve), ms);
      const end = (/** @type {(value?: any) => void} */ then, /** @type {unknown} */ value = undefined) => {
        clearTimeout(timer);
        over.abort();
        then(value);
      };
      if (lost) addEventListener('online', () => end(resolve), { signal: over.signal });
      const stop = () => end(reject, new DOMException('Cancelled.', 'AbortError'));
      cancelled.signal.addEventListener('abort', stop, { signal: over.signal });
    });
  }
}

/** @param {XMLHttpRequest} xhr */
function json(xhr) {
  try {
    return JSON.parse(xhr.responseText);
  } catch {
    throw new Error('The server gave an answer that is no JSON.');
  }
}

// Uploads a photo to the server.

import { wordsOf } from './api.js';
import { at } from './dom.js';

/** @import { Photo } from './api.js' */

/**
 * The error of a refused upload; `retryAfter` in seconds if the server is only busy.
 * @param {XMLHttpRequest} xhr
 */
function refusal(xhr) {
  const error = /** @type {Error & {retryAfter?: number}} */ (new Error(wordsOf(xhr.status, xhr.statusText, xhr.responseText)));
  const seconds = Number(xhr.getResponseHeader('retry-after'));
  if ((xhr.status === 429 || xhr.status === 503) && seconds > 0) error.retryAfter = Math.ceil(seconds);
  return error;
}

/**
 * Uploads a file, its depth map or second eye if there is one, and options by name.
 * @param {File} file
 * @param {{depth: File | null, second?: File}} beside at most one of them
 * @param {Record<string, string | number>} options
 * @param {(share: number) => void} onProgress is called with the share of bytes sent, 0 to 1
 * @returns {{done: Promise<Photo>, abort: () => void}} `done` resolves to the photo's JSON
 */
export function uploadPhoto(file, beside, options, onProgress) {
  const form = new FormData();
  for (const [name, value] of Object.entries(options)) form.append(name, String(value));
  form.append('photo', file, file.name || 'photo');
  for (const [name, other] of Object.entries(beside)) if (other) form.append(name, other, other.name || name);
  const xhr = new XMLHttpRequest();
  const done = new Promise((resolve, reject) => {
    xhr.upload.onprogress = (event) => event.lengthComputable && onProgress(event.loaded / event.total);
    xhr.onload = () => {
      if (xhr.status < 200 || xhr.status > 299) return reject(refusal(xhr));
      try {
        resolve(JSON.parse(xhr.responseText));
      } catch {
        reject(new Error('The server gave an answer that is no JSON.'));
      }
    };
    xhr.onerror = () => reject(new Error('The server cannot be reached.'));
    xhr.onabort = () => reject(new DOMException('Cancelled.', 'AbortError'));
  });
  xhr.open('POST', at('/v1/photos'));
  xhr.setRequestHeader('Accept', 'application/json');
  xhr.send(form);
  return { done, abort: () => xhr.abort() };
}

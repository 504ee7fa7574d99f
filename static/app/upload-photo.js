// Sends a photo to the server.

import { wordsOf } from './api.js';
import { LARGE_BYTES, NoParts, sendInParts } from './parts.js';

/** @import { Photo } from './api.js' */
/** @import { Progress } from './parts.js' */

/**
 * The error of a refused upload; `retryAfter` in seconds where the server is only busy.
 * @param {XMLHttpRequest} xhr
 */
function refusal(xhr) {
  const error = /** @type {Error & {retryAfter?: number}} */ (new Error(wordsOf(xhr.status, xhr.statusText, xhr.responseText)));
  const seconds = Number(xhr.getResponseHeader('retry-after'));
  if ((xhr.status === 429 || xhr.status === 503) && seconds > 0) error.retryAfter = Math.ceil(seconds);
  return error;
}

/**
 * Uploads a file, with its depth map where there is one and options by name; a large one goes on by itself where the connection is lost.
 * `onProgress` runs while bytes go out.
 * @param {File} file
 * @param {File | null} depth
 * @param {Record<string, number>} options
 * @param {Progress} onProgress
 * @returns {{done: Promise<Photo>, abort: () => void}} `done` gives the photo's JSON
 */
export function uploadPhoto(file, depth, options, onProgress) {
  const form = new FormData();
  for (const [name, value] of Object.entries(options)) form.append(name, String(value));
  form.append('photo', file, file.name || 'photo');
  if (depth) form.append('depth', depth, depth.name || 'depth');
  if (file.size + (depth?.size ?? 0) < LARGE_BYTES) return sendAtOnce(form, onProgress);
  let going = sendInParts(form, refusal, onProgress);
  const done = going.done.catch((error) => {
    if (!(error instanceof NoParts)) throw error;
    going = sendAtOnce(form, onProgress);
    return going.done;
  });
  return { done, abort: () => going.abort() };
}

/**
 * @param {FormData} form
 * @param {Progress} onProgress
 * @returns {{done: Promise<Photo>, abort: () => void}}
 */
function sendAtOnce(form, onProgress) {
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
  xhr.open('POST', '/v1/photos');
  xhr.setRequestHeader('Accept', 'application/json');
  xhr.send(form);
  return { done, abort: () => xhr.abort() };
}

// Error messages from the server's responses.

/**
 * The message of a failed response: the problem's detail (RFC 9457), or the status.
 * @param {Response} response
 */
export async function problemOf(response) {
  return problemText(response.status, response.statusText, await response.text().catch(() => ''));
}

/**
 * The same for a response in parts; a status of 0 means that there was no response.
 * @param {number} status
 * @param {string} statusText
 * @param {string} body
 */
export function problemText(status, statusText, body) {
  try {
    const problem = JSON.parse(body);
    const text = problem.detail || problem.title;
    if (typeof text === 'string' && text) return text;
  } catch {
    // not JSON: fall back to the status
  }
  return status ? `The server answered ${status} ${statusText}`.trim() : 'The server cannot be reached.';
}

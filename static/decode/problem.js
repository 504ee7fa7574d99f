// What the server says where it refuses.

/** What a failed response says for a person: the problem's detail (RFC 9457), or the status. */
export async function problemOf(response) {
  return problemText(response.status, response.statusText, await response.text().catch(() => ''));
}

/** The same from what is known of the response; a status of 0 is none. */
export function problemText(status, statusText, body) {
  try {
    const problem = JSON.parse(body);
    const text = problem.detail || problem.title;
    if (typeof text === 'string' && text) return text;
  } catch {
    // not JSON: the status has to do
  }
  return status ? `The server answered ${status} ${statusText}`.trim() : 'The server cannot be reached.';
}

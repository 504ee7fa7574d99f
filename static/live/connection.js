// Connects a page to a room: polls until somebody publishes, connects, and reconnects after a failure.

/** WebSocket subprotocol, and the prefix of a second one that carries the token: browsers cannot set headers on a WebSocket. */
const PROTOCOL = 'tmpi.live.v1';
const TOKEN = 'token.';
/** Silence after which a connection counts as lost, ms: the server sends something every second. */
const SILENCE_MS = 4000;
/** Pauses before successive reconnects, ms. */
const PAUSES_MS = [100, 300, 700, 1500];
/** Interval between polls for a publisher, ms. */
const POLL_MS = 1000;
/** Pauses before successive retries of a full room, ms. */
const FULL_PAUSES_MS = [5000, 10_000, 20_000, 30_000];
/** Timeout of a status request, ms. */
const STATUS_TIMEOUT_MS = 10_000;
/** CREDIT messages (field 8) of a viewer: no frames while nobody looks; frames again, from a key frame on. */
export const SOUND_ALONE = Uint8Array.of((8 << 3) | 2, 0);
export const EVERYTHING = Uint8Array.of((8 << 3) | 2, 4, 1 << 3, 1, 2 << 3, 1);

/**
 * `waiting`: no publisher yet; `refused`: the token is missing or invalid; `none`: no such room; `away`: the server is unreachable; `full`:
 * no place for another viewer.
 * @typedef {'connecting' | 'waiting' | 'refused' | 'away' | 'none' | 'open' | 'full'} State
 */

/**
 * Headers for requests about a room.
 * @param {string} token
 * @returns {Record<string, string>}
 */
export function headersOf(token) {
  return token ? { authorization: `Bearer ${token}` } : {};
}

/**
 * Opens a WebSocket to a room.
 * @param {string} address of the room, `http:` or `https:`
 * @param {'publish' | 'subscribe'} what
 * @param {string} token
 */
export function openSocket(address, what, token) {
  const url = new URL(`${address}/${what}`);
  url.protocol = url.protocol.replace('http', 'ws');
  const socket = new WebSocket(url, token ? [PROTOCOL, TOKEN + token] : [PROTOCOL]);
  socket.binaryType = 'arraybuffer';
  return socket;
}

/**
 * Fetches the status of a room.
 * @param {string} address
 * @param {string} token
 * @returns {Promise<{state: State, mayPublish: boolean, publishing: boolean, viewers: number, full: boolean, ended: string}>} `ended`: why the last publisher left
 */
export async function fetchStatus(address, token) {
  const unknown = { mayPublish: false, publishing: false, viewers: 0, full: false, ended: '' };
  try {
    const response = await fetch(address, { headers: headersOf(token), signal: AbortSignal.timeout(STATUS_TIMEOUT_MS) });
    if (response.status === 403 || response.status === 401) return { ...unknown, state: 'refused' };
    if (response.status === 404) return { ...unknown, state: 'none' };
    if (!response.ok) return { ...unknown, state: 'away' };
    const { publishing, viewers, full = false, may_publish: mayPublish, ended = '' } = await response.json();
    return { state: publishing ? 'open' : 'waiting', publishing, viewers, full, mayPublish, ended };
  } catch {
    return { ...unknown, state: 'away' };
  }
}

export class Connection {
  #room;
  #on;
  /** @type {WebSocket | null} */
  #socket = null;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #timer;
  /** @type {ReturnType<typeof setTimeout> | undefined} */
  #silence;
  #tries = 0;
  /** Retries since the room was first found full. */
  #fullTries = 0;
  #run = 0;

  /**
   * @param {{address: string, token: string}} room
   * @param {{message: (bytes: Uint8Array<ArrayBuffer>) => void, state: (state: State, ended: string) => void}} on
   */
  constructor(room, on) {
    this.#room = room;
    this.#on = on;
  }

  /** Connects now. */
  async start() {
    this.stop();
    const run = this.#run;
    const { state, full, ended } = await fetchStatus(this.#room.address, this.#room.token);
    if (run !== this.#run) return;
    if (state === 'open' && full) return this.full();
    if (state !== 'open') {
      this.#on.state(state, ended);
      if (state === 'waiting') this.#startAfter(POLL_MS);
      else if (state === 'away') this.#retry();
      return;
    }
    const socket = openSocket(this.#room.address, 'subscribe', this.#room.token);
    this.#socket = socket;
    this.#watchSilence();
    socket.onmessage = ({ data }) => {
      this.#watchSilence();
      this.#on.message(new Uint8Array(data));
    };
    socket.onclose = () => {
      this.stop();
      this.#retry();
    };
  }

  /**
   * Sends a message; returns false if the socket is not open.
   * @param {Uint8Array<ArrayBuffer>} message
   */
  send(message) {
    if (this.#socket?.readyState !== WebSocket.OPEN) return false;
    this.#socket.send(message);
    return true;
  }

  /** Resets the pauses after the stream has started. */
  succeeded() {
    this.#tries = this.#fullTries = 0;
  }

  /** Retries a full room, at growing intervals. */
  full() {
    this.stop();
    this.#on.state('full', '');
    this.#startAfter(FULL_PAUSES_MS[Math.min(this.#fullTries++, FULL_PAUSES_MS.length - 1)]);
  }

  stop() {
    this.#run++;
    clearTimeout(this.#timer);
    clearTimeout(this.#silence);
    if (!this.#socket) return;
    this.#socket.onclose = this.#socket.onmessage = null;
    this.#socket.close();
    this.#socket = null;
  }

  /** Reconnects after a growing pause. */
  #retry() {
    this.#startAfter(PAUSES_MS[Math.min(this.#tries++, PAUSES_MS.length - 1)]);
  }

  /** @param {number} ms */
  #startAfter(ms) {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.start(), ms);
  }

  #watchSilence() {
    clearTimeout(this.#silence);
    this.#silence = setTimeout(() => {
      this.stop();
      this.#retry();
    }, SILENCE_MS);
  }
}

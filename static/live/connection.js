// A page's way into a room: looks whether there is anybody, connects, and comes back where the connection breaks.

/** Protocol of the web sockets, and what a token is put behind among protocols: they have no headers for it. */
const PROTOCOL = 'tmpi.live.v1';
const TOKEN = 'token.';
/** Silence after which a connection is taken for dead: the server says something each second, ms. */
const SILENCE_MS = 4000;
/** Pauses before it is tried again, from the first on, ms. */
const PAUSES_MS = [100, 300, 700, 1500];
/** Pause between two looks whether somebody publishes, ms. */
const LOOK_MS = 1000;
/** Pauses before a room that is full is tried again, from the first on, ms. */
const FULL_MS = [5000, 10_000, 20_000, 30_000];
/** Time that an answer may take, ms. */
const ANSWER_MS = 10_000;
/** CREDIT (`credit`, 8) as who watches says it: of no frames, as nobody looks, and of one from a key frame on, as somebody does again. */
export const SOUND_ALONE = Uint8Array.of((8 << 3) | 2, 0);
export const EVERYTHING = Uint8Array.of((8 << 3) | 2, 4, 1 << 3, 1, 2 << 3, 1);

/** @typedef {'connecting' | 'waiting' | 'refused' | 'away' | 'none' | 'open' | 'full'} State `waiting` for a publisher, `refused` for want of a token, `none`: there are no rooms, `away`: the server cannot be reached, `full`: as many watch as may */

/**
 * Headers of requests about a room.
 * @param {string} token
 * @returns {Record<string, string>}
 */
export function headersOf(token) {
  return token ? { authorization: `Bearer ${token}` } : {};
}

/**
 * Opens a web socket of a room.
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
 * What the server says of a room.
 * @param {string} address
 * @param {string} token
 * @returns {Promise<{state: State, mayPublish: boolean, publishing: boolean, viewers: number, full: boolean, ended: string}>} `ended`: why the last publisher has gone
 */
export async function look(address, token) {
  const found = { mayPublish: false, publishing: false, viewers: 0, full: false, ended: '' };
  try {
    const response = await fetch(address, { headers: headersOf(token), signal: AbortSignal.timeout(ANSWER_MS) });
    if (response.status === 403 || response.status === 401) return { ...found, state: 'refused' };
    if (response.status === 404) return { ...found, state: 'none' };
    if (!response.ok) return { ...found, state: 'away' };
    const { publishing, viewers, full = false, may_publish: mayPublish, ended = '' } = await response.json();
    return { state: publishing ? 'open' : 'waiting', publishing, viewers, full, mayPublish, ended };
  } catch {
    return { ...found, state: 'away' };
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
  /** How often there was no place. */
  #crowded = 0;
  #run = 0;

  /**
   * @param {{address: string, token: string}} room
   * @param {{message: (bytes: Uint8Array<ArrayBuffer>) => void, state: (state: State, ended: string) => void}} on
   */
  constructor(room, on) {
    this.#room = room;
    this.#on = on;
  }

  /** Connects, now. */
  async start() {
    this.stop();
    const run = this.#run;
    const { state, full, ended } = await look(this.#room.address, this.#room.token);
    if (run !== this.#run) return;
    if (state === 'open' && full) return this.full();
    if (state !== 'open') {
      this.#on.state(state, ended);
      if (state === 'waiting') this.#again(LOOK_MS);
      else if (state === 'away') this.#later();
      return;
    }
    const socket = openSocket(this.#room.address, 'subscribe', this.#room.token);
    this.#socket = socket;
    this.#listen();
    socket.onmessage = ({ data }) => {
      this.#listen();
      this.#on.message(new Uint8Array(data));
    };
    socket.onclose = () => {
      this.stop();
      this.#later();
    };
  }

  /**
   * Says something to the server; false where nothing is open.
   * @param {Uint8Array<ArrayBuffer>} message
   */
  send(message) {
    if (this.#socket?.readyState !== WebSocket.OPEN) return false;
    this.#socket.send(message);
    return true;
  }

  /** A message was as it should: the next try comes soon. */
  well() {
    this.#tries = this.#crowded = 0;
  }

  /** Tries for a place in the full room, less and less often. */
  full() {
    this.stop();
    this.#on.state('full', '');
    this.#again(FULL_MS[Math.min(this.#crowded++, FULL_MS.length - 1)]);
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

  /** Tries again after a pause that grows. */
  #later() {
    this.#again(PAUSES_MS[Math.min(this.#tries++, PAUSES_MS.length - 1)]);
  }

  /** @param {number} ms */
  #again(ms) {
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => this.start(), ms);
  }

  #listen() {
    clearTimeout(this.#silence);
    this.#silence = setTimeout(() => {
      this.stop();
      this.#later();
    }, SILENCE_MS);
  }
}

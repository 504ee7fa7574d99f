// Views of a room that the server draws, one after the other, as fast as they come.
import { viewAddress } from '../draw/server-views.js';
import { headersOf } from './connection.js';

/** @import { Frame, Pose } from '../view/camera.js' */

/**
 * Time from one request to the next, ms: servers let an address have 600 views a minute as a rule. Where one allows fewer it is doubled, up to
 * the most.
 */
const [EACH_MS, MOST_MS] = [110, 3520];
/** Pause where nobody is live, or the server cannot be reached, ms. */
const AWAY_MS = 1000;
/** Time without a newer frame after which the picture stands still, ms. */
const STALLED_MS = 3000;
/** Time that a view may take, ms. */
const ANSWER_MS = 15_000;
/** Pause where the server asks for one without saying how long, ms. */
const BUSY_MS = 2000;

export class ServedViews {
  #image;
  #room;
  #size;
  #on;
  /** @type {string | null} */
  #wanted = null;
  #busy = false;
  #each = EACH_MS;
  #disposed = false;
  /** Object URL of the view that is shown, its tag and its address. */
  #shown = { source: '', tag: '', address: '' };
  /** Number of the newest frame that was shown, and when it was first. */
  #newest = { frame: '', at: 0 };

  /**
   * @param {HTMLImageElement} image where the views are shown
   * @param {{address: string, token: string}} room
   * @param {{width: number, height: number}} size of its frames
   * @param {{shown: (fresh: boolean) => void, refused: (state: string) => void}} on `shown`: a view is there, and whether frames still come;
   *   `refused`: why there is none, as a state (connection.js), or `busy`
   */
  constructor(image, room, size, on) {
    this.#image = image;
    this.#room = room;
    this.#size = size;
    this.#on = on;
  }

  /**
   * Shows what is seen from there, frame after frame until it is stopped; one request at a time, of the latest pose.
   * @param {Pose} pose
   * @param {number} fov horizontal, of the whole picture, degrees
   * @param {{width: number, height: number}} size wanted, device pixels
   * @param {Frame} frame
   */
  show(pose, fov, size, frame) {
    this.#wanted = viewAddress(`${this.#room.address}/frames/latest/view`, this.#size, pose, fov, size, frame);
    this.#run();
  }

  /** Asks for no more. */
  stop() {
    this.#wanted = null;
  }

  async #run() {
    if (this.#busy) return;
    this.#busy = true;
    while (this.#wanted && !this.#disposed) {
      const began = performance.now();
      const least = await this.#next(this.#wanted);
      const pause = Math.max(least, this.#each - (performance.now() - began));
      if (pause > 0) await new Promise((resume) => setTimeout(resume, pause));
    }
    this.#busy = false;
  }

  /**
   * Shows the next view; gives the least pause before another is asked for, ms.
   * @param {string} address
   */
  async #next(address) {
    const { tag } = this.#shown;
    const headers = headersOf(this.#room.token);
    if (tag && this.#shown.address === address) headers['if-none-match'] = tag;
    try {
      // one that is never answered would be waited for without end
      const response = await fetch(address, { headers, cache: 'no-store', signal: AbortSignal.timeout(ANSWER_MS) });
      if (response.status === 304) {
        this.#tell();
        return 0;
      }
      if (!response.ok) return this.#refuse(response);
      const source = URL.createObjectURL(await response.blob());
      if (this.#disposed) {
        URL.revokeObjectURL(source);
        return 0;
      }
      this.#image.src = source;
      await this.#image.decode();
      if (this.#shown.source) URL.revokeObjectURL(this.#shown.source);
      this.#shown = { source, tag: response.headers.get('etag') ?? '', address };
      const frame = response.headers.get('x-tmpi-frame') ?? '';
      if (frame !== this.#newest.frame) this.#newest = { frame, at: performance.now() };
      this.#tell();
      return 0;
    } catch {
      if (!this.#disposed) this.#on.refused('away');
      return AWAY_MS;
    }
  }

  /** A view is there, unless nobody wants it any more. */
  #tell() {
    if (this.#wanted && !this.#disposed) this.#on.shown(performance.now() - this.#newest.at < STALLED_MS);
  }

  /** @param {Response} response */
  #refuse(response) {
    if (this.#disposed) return 0;
    const { status, headers } = response;
    if (status === 401 || status === 403) {
      this.stop();
      this.#on.refused('refused');
      return 0;
    }
    if (status === 404) {
      this.#on.refused('waiting');
      return AWAY_MS;
    }
    if (status === 429) this.#each = Math.min(MOST_MS, 2 * this.#each);
    this.#on.refused('busy');
    return Number(headers.get('retry-after')) * 1000 || BUSY_MS;
  }

  dispose() {
    this.#disposed = true;
    if (this.#shown.source) URL.revokeObjectURL(this.#shown.source);
  }
}

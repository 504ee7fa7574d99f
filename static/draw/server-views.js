// Shows views that the server draws, for browsers that cannot draw them.
import { problemOf } from '../decode/problem.js';
import { POSE_KEYS } from '../view/camera.js';

const KEPT = 64;
/** @import { Frame, Pose } from '../view/camera.js' */

/** Longest side of a requested view, pixels. */
const MAX_SIDE = 1280;
const SIZE_STEP = 64;

export class ServerViews {
  /**
   * @param {HTMLImageElement} image that shows the views
   * @param {string} url of the photo's view resource
   * @param {{width: number, height: number}} size of the photo
   * @param {(error: Error) => void} onError
   */
  constructor(image, url, size, onError) {
    this.image = image;
    this.url = url;
    this.size = size;
    this.onError = onError;
    /** @type {Map<string, string>} */
    this.kept = new Map();
    /** @type {string | null} */
    this.wanted = null;
    this.busy = false;
    this.disposed = false;
    /** @type {string | null} */
    this.shown = null;
  }

  /**
   * Requests a view; the latest call wins, and at most one request is in flight.
   * @param {Pose} pose
   * @param {number} fov horizontal, of the whole photo, degrees
   * @param {{width: number, height: number}} size wanted, device pixels
   * @param {Frame} frame
   */
  show(pose, fov, size, frame) {
    this.wanted = viewAddress(this.url, this.size, pose, fov, size, frame);
    if (!this.busy) this.#next();
  }

  async #next() {
    this.busy = true;
    try {
      while (!this.disposed && this.wanted && this.wanted !== this.shown) {
        const address = this.wanted;
        const source = this.kept.get(address) ?? (await fetchView(address));
        if (this.disposed) {
          URL.revokeObjectURL(source);
          return;
        }
        this.#keep(address, source);
        this.image.src = source;
        await this.image.decode();
        this.shown = address;
      }
    } catch (error) {
      this.wanted = null;
      if (!this.disposed) this.onError(error);
    } finally {
      this.busy = false;
    }
  }

  /**
   * Caches the most recently used views.
   * @param {string} address
   * @param {string} source
   */
  #keep(address, source) {
    this.kept.delete(address);
    this.kept.set(address, source);
    if (this.kept.size <= KEPT) return;
    const [[oldest, old]] = this.kept;
    this.kept.delete(oldest);
    URL.revokeObjectURL(old);
  }

  dispose() {
    this.disposed = true;
    for (const source of this.kept.values()) URL.revokeObjectURL(source);
    this.kept.clear();
  }
}

/**
 * Address of a view.
 * @param {string} url of the view resource
 * @param {{width: number, height: number}} size of the photo
 * @param {Pose} pose
 * @param {number} fov horizontal, of the whole photo, degrees
 * @param {{width: number, height: number}} wanted size, device pixels
 * @param {Frame} frame
 */
function viewAddress(url, size, pose, fov, wanted, frame) {
  const aspect = frame.scale > 1 ? wanted.height / wanted.width : size.height / size.width;
  const limit = Math.min(MAX_SIDE, MAX_SIDE / aspect);
  const width = Math.max(1, Math.round(Math.min(limit, Math.ceil(wanted.width / SIZE_STEP) * SIZE_STEP)));
  const height = Math.max(1, Math.round(width * aspect));
  const query = new URLSearchParams();
  for (const key of POSE_KEYS) if (pose[key]) query.set(key, pose[key].toFixed(5));
  query.set('w', String(width));
  query.set('h', String(height));
  query.set('fov', fov.toFixed(4));
  const crop = cropOf(frame, (width * size.height) / (height * size.width));
  if (crop) query.set('crop', crop);
  query.set('format', 'jpeg');
  return `${url}${url.includes('?') ? '&' : '?'}${query}`;
}

/**
 * The server's `crop` parameter for a frame, or '' for the whole photo.
 * @param {Frame} frame
 * @param {number} wider aspect ratio of the picture divided by that of the photo
 */
function cropOf({ scale, x, y }, wider) {
  const [w, h] = [Math.min(1, 1 / scale), Math.min(1, 1 / scale / wider)];
  if (w > 0.999 && h > 0.999) return '';
  const corner = (/** @type {number} */ middle, /** @type {number} */ side) => Math.max(0, Math.min(1 - side, middle - side / 2));
  return [corner(x, w), corner(y, h), w, h].map((v) => v.toFixed(4)).join(',');
}

/** @param {string} address */
async function fetchView(address) {
  const response = await fetch(address);
  if (!response.ok) throw new Error(await problemOf(response));
  return URL.createObjectURL(await response.blob());
}

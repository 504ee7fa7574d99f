// The area that a stroke covers, as crates/pipeline/src/strokes finds it, for a live preview; and what strokes do to a depth map.

/**
 * A stroke as the server takes it: a middle line in shares of width and height, a radius in shares of the longer side, and one of three
 * wishes.
 * @typedef {{points: [number, number][], radius: number, by?: number, like?: [number, number], to?: number}} Stroke
 */
/** @typedef {{x0: number, y0: number, width: number, height: number, mask: Uint8Array}} Region pixels inside are 1 */

/** Longest side of the picture on which outlines are computed. */
export const SIDE = 640;
// the same weights as on the server, see there
const EDGE = 36;
const DEPTH = 0.5;
const TEXTURE = 2;
const LINE = 0.71;
const PROBE = 0.005;
const SMOOTH = [3 / 16, 10 / 16, 3 / 16];

export class Outlines {
  /**
   * @param {number} width
   * @param {number} height
   * @param {Uint8ClampedArray} rgba the photo
   * @param {Float32Array} map its disparity, 0 to 1
   */
  constructor(width, height, rgba, map) {
    this.width = width;
    this.height = height;
    this.edges = new Float32Array(width * height);
    for (let y = 0; y < height; y++) {
      for (let x = 0; x < width; x++) {
        let colour = 0;
        for (let c = 0; c < 3; c++) colour += this.#slope(x, y, (i) => rgba[4 * i + c] / 255);
        this.edges[y * width + x] = colour / 3 + DEPTH * this.#slope(x, y, (i) => map[i]);
      }
    }
  }

  /**
   * @param {Stroke} stroke
   * @returns {Region}
   */
  region(stroke) {
    const radius = Math.max(stroke.radius * Math.max(this.width, this.height), 1);
    const line = thinned(stroke, this.width, this.height, radius / 8);
    const reach = 2 * radius + 2;
    const span = (/** @type {number[]} */ all, /** @type {number} */ n) => {
      const low = Math.min(Math.floor(Math.max(Math.min(...all) - reach, 0)), n - 1);
      return [low, Math.min(Math.max(Math.ceil(Math.max(...all) + reach), low + 1), n)];
    };
    const xs = line.map(([x]) => x);
    const ys = line.map(([, y]) => y);
    const [x0, x1] = span(xs, this.width);
    const [y0, y1] = span(ys, this.height);
    const rectangle = { x0, y0, width: x1 - x0, height: y1 - y0 };
    const away = distances(line, rectangle, reach);
    const step = this.#steps(rectangle, away, radius);
    return { ...rectangle, mask: cell(rectangle, away, step, radius) };
  }

  /**
   * Squared strength of the edge at a pixel.
   * @param {number} x
   * @param {number} y
   * @param {(i: number) => number} value
   */
  #slope(x, y, value) {
    const { width, height } = this;
    const xs = [Math.max(x - 1, 0), x, Math.min(x + 1, width - 1)];
    const ys = [Math.max(y - 1, 0), y, Math.min(y + 1, height - 1)];
    let gx = 0;
    let gy = 0;
    for (let k = 0; k < 3; k++) {
      gx += SMOOTH[k] * (value(ys[k] * width + xs[2]) - value(ys[k] * width + xs[0]));
      gy += SMOOTH[k] * (value(ys[2] * width + xs[k]) - value(ys[0] * width + xs[k]));
    }
    return gx * gx + gy * gy;
  }

  /**
   * Cost of a step through each pixel of a rectangle, in radii.
   * @param {Omit<Region, 'mask'>} rectangle
   * @param {Float32Array} away
   * @param {number} radius
   */
  #steps({ x0, y0, width, height }, away, radius) {
    const edges = new Float32Array(width * height);
    for (let i = 0; i < edges.length; i++) edges[i] = this.edges[(y0 + Math.floor(i / width)) * this.width + x0 + (i % width)];
    const near = edges.filter((_, i) => away[i] < 2 * radius).sort();
    const texture = near.length ? TEXTURE * near[near.length >> 1] : 0;
    return edges.map((edge) => 1 / radius + EDGE * Math.max(edge - texture, 0));
  }
}

/**
 * Applies strokes to a copy of a depth map of the size of `outlines`.
 * @param {Outlines} outlines
 * @param {Float32Array} map
 * @param {{stroke: Stroke, region: Region}[]} strokes
 */
export function touchedUp({ width, height }, map, strokes) {
  const out = map.slice();
  for (const { stroke, region } of strokes) {
    const flat = stroke.like ? around(out, width, height, stroke.like) : stroke.to;
    each(region, width, (i) => {
      out[i] = flat ?? Math.min(Math.max(out[i] + (stroke.by ?? 0), 0), 1);
    });
  }
  return out;
}

/**
 * Calls `f` with the index of each pixel of a region in its picture.
 * @param {Region} region
 * @param {number} width of the picture
 * @param {(i: number) => void} f
 */
export function each({ x0, y0, width: w, height: h, mask }, width, f) {
  for (let y = 0; y < h; y++) for (let x = 0; x < w; x++) if (mask[y * w + x]) f((y0 + y) * width + x0 + x);
}

/**
 * The median around a point.
 * @param {Float32Array} map
 * @param {number} width
 * @param {number} height
 * @param {[number, number]} place
 */
function around(map, width, height, [px, py]) {
  const reach = Math.floor(PROBE * Math.max(width, height));
  const cx = Math.min(Math.floor(px * width), width - 1);
  const cy = Math.min(Math.floor(py * height), height - 1);
  const all = [];
  for (let y = Math.max(cy - reach, 0); y < Math.min(cy + reach + 1, height); y++)
    for (let x = Math.max(cx - reach, 0); x < Math.min(cx + reach + 1, width); x++) all.push(map[y * width + x]);
  return all.sort((a, b) => a - b)[all.length >> 1];
}

/**
 * The line of a stroke in pixels, without points that are closer than `least` to the one before.
 * @param {Stroke} stroke
 * @param {number} width
 * @param {number} height
 * @param {number} least
 */
function thinned({ points }, width, height, least) {
  /** @type {[number, number][]} */
  const line = [];
  points.forEach(([px, py], i) => {
    const [x, y] = [px * width, py * height];
    const last = line.at(-1);
    if (!last || Math.hypot(x - last[0], y - last[1]) >= least || i === points.length - 1) line.push([x, y]);
  });
  return line;
}

/**
 * How far each pixel of a rectangle is off a line, in pixels; infinite beyond `reach`.
 * @param {[number, number][]} line
 * @param {Omit<Region, 'mask'>} rectangle
 * @param {number} reach
 */
function distances(line, { x0, y0, width, height }, reach) {
  const away = new Float32Array(width * height).fill(Infinity);
  line.forEach((b, k) => {
    const a = line[Math.max(k - 1, 0)];
    const [dx, dy] = [b[0] - a[0], b[1] - a[1]];
    const square = dx * dx + dy * dy;
    const left = Math.max(Math.floor(Math.min(a[0], b[0]) - reach - x0), 0);
    const right = Math.min(Math.ceil(Math.max(a[0], b[0]) + reach - x0), width);
    const bottom = Math.min(Math.ceil(Math.max(a[1], b[1]) + reach - y0), height);
    for (let y = Math.max(Math.floor(Math.min(a[1], b[1]) - reach - y0), 0); y < bottom; y++) {
      for (let x = left; x < right; x++) {
        const [px, py] = [x0 + x + 0.5 - a[0], y0 + y + 0.5 - a[1]];
        const t = square > 0 ? Math.min(Math.max((px * dx + py * dy) / square, 0), 1) : 0;
        const d = Math.hypot(px - t * dx, py - t * dy);
        if (d < away[y * width + x]) away[y * width + x] = d;
      }
    }
  });
  return away;
}

/**
 * Separates the stroke's cell from everything farther than two radii, by Dijkstra's algorithm from both sides at once.
 * @param {{width: number, height: number}} rectangle
 * @param {Float32Array} away
 * @param {Float32Array} step
 * @param {number} radius
 */
function cell({ width, height }, away, step, radius) {
  const least = new Float32Array(away.length).fill(Infinity);
  const inside = new Uint8Array(away.length);
  const heap = new Heap();
  away.forEach((d, i) => {
    const onLine = d <= LINE;
    if (!onLine && d < 2 * radius) return;
    least[i] = 0;
    inside[i] = onLine ? 1 : 0;
    heap.push(0, i);
  });
  while (heap.size) {
    const [cost, i] = heap.pop();
    if (cost > least[i]) continue;
    const x = i % width;
    const y = (i - x) / width;
    for (let ny = Math.max(y - 1, 0); ny < Math.min(y + 2, height); ny++) {
      for (let nx = Math.max(x - 1, 0); nx < Math.min(x + 2, width); nx++) {
        const n = ny * width + nx;
        const length = nx !== x && ny !== y ? Math.SQRT2 : 1;
        const there = Math.fround(cost + length * 0.5 * (step[i] + step[n]));
        if (there >= least[n]) continue;
        least[n] = there;
        inside[n] = inside[i];
        heap.push(there, n);
      }
    }
  }
  return inside;
}

/** Pairs of a cost and an index, the least cost first. */
class Heap {
  /** @type {number[]} */
  #costs = [];
  /** @type {number[]} */
  #items = [];

  get size() {
    return this.#costs.length;
  }

  /**
   * @param {number} cost
   * @param {number} item
   */
  push(cost, item) {
    let at = this.#costs.length;
    while (at > 0) {
      const above = (at - 1) >> 1;
      if (this.#costs[above] <= cost) break;
      this.#costs[at] = this.#costs[above];
      this.#items[at] = this.#items[above];
      at = above;
    }
    this.#costs[at] = cost;
    this.#items[at] = item;
  }

  /** @returns {[number, number]} */
  pop() {
    /** @type {[number, number]} */
    const first = [this.#costs[0], this.#items[0]];
    const cost = /** @type {number} */ (this.#costs.pop());
    const item = /** @type {number} */ (this.#items.pop());
    const n = this.#costs.length;
    if (!n) return first;
    let at = 0;
    for (;;) {
      let below = 2 * at + 1;
      if (below >= n) break;
      if (below + 1 < n && this.#costs[below + 1] < this.#costs[below]) below++;
      if (this.#costs[below] >= cost) break;
      this.#costs[at] = this.#costs[below];
      this.#items[at] = this.#items[below];
      at = below;
    }
    this.#costs[at] = cost;
    this.#items[at] = item;
    return first;
  }
}

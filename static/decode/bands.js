// Labels, and from planes and labels to texels and their colours, in bands of tiles that know nothing of each other: each may go to a
// thread of its own, and together they are what one alone would come to.
import { fillHidden } from './fill.js';
import { concatenated, decodeBands } from './labels.js';
import { MARGIN_ROWS, peel, surfaceOf } from './peel.js';
import { Class } from './scene.js';

/**
 * Cuts the tiles of a scene into at most `count` bands of about as many labelled planes each.
 * @param {object} scene its head, and its photo
 * @param {Array<object>} tiles as `peel` takes them
 * @param {boolean} fill whether hidden colours are to be filled in
 */
export function cutIntoBands(scene, tiles, count, fill) {
  const { photo, ...head } = scene;
  const whole = { head: { ...head, top: 0 }, surface: surfaceOf(scene, tiles), data: photo.data, fill };
  const all = tiles.reduce((sum, { planes }) => sum + planes.length, 0);
  const bands = [];
  let first = 0;
  let planes = 0;
  tiles.forEach((tile, i) => {
    planes += tile.planes.length;
    if (i + 1 < tiles.length && planes < (all * (bands.length + 1)) / count) return;
    bands.push({ ...whole, tiles: tiles.slice(first, i + 1) });
    first = i + 1;
  });
  return bands;
}

/** Does a job, on whatever thread: `{labels}` bands of labels to read, else a band of tiles to unfold. */
export function work(job) {
  return job.labels ? { labels: decodeBands(job.labels) } : unfold(job);
}

/** A copy of a job with nothing but what it depends on, and the buffers that can be handed over with it. */
export function detached(job) {
  if (!job.labels) return detachedBand(job);
  const labels = job.labels.map((band) => ({ ...band, counts: band.counts.slice(), bytes: band.bytes.slice() }));
  return { band: { labels }, buffers: buffersOf(labels.flatMap(({ counts, bytes }) => [counts, bytes])) };
}

/** The buffers of what `work` gave. */
export function resultBuffers({ labels, layers = {}, classes, alpha, hidden }) {
  return buffersOf([labels, classes, alpha, hidden, ...Object.values(layers)]);
}

function detachedBand({ head, tiles, surface, data, fill }) {
  const top = Math.max(tiles[0].rect.y - MARGIN_ROWS, 0);
  const bottom = Math.min(Math.max(...tiles.map(({ rect }) => rect.y + rect.h)) + MARGIN_ROWS, head.height);
  const rows = (from, channels) => from.slice(top * head.width * channels, bottom * head.width * channels);
  const labels = new Uint8Array(tiles.reduce((sum, tile) => sum + tile.labels.length, 0));
  let at = 0;
  const own = tiles.map((tile) => {
    const room = labels.subarray(at, (at += tile.labels.length));
    room.set(tile.labels);
    return { ...tile, labels: room };
  });
  const band = { head: { ...head, top }, tiles: own, surface: rows(surface, 1), data: fill ? rows(data, 4) : null, fill };
  return { band, buffers: buffersOf([labels, band.surface, band.data]) };
}

/** The buffers of arrays, each once. */
export function buffersOf(arrays) {
  return [...new Set(arrays.filter((a) => ArrayBuffer.isView(a)).map((a) => a.buffer))];
}

/** Layers of a band of tiles: columns over all of them, classes and alpha of all their texels, and the hidden ones' RGB. */
export function unfold({ head, tiles, surface, data, fill }) {
  const shapes = peel(head, tiles, surface);
  const part = readLayers(tiles, shapes);
  const hidden = describeLayers(part);
  part.hidden = fill ? fillHidden({ ...head, photo: { data } }, tiles, shapes, hidden, surface) : new Uint8Array(0);
  return part;
}

/** What `unfold` would have given of all bands at once. */
export function joined(parts) {
  if (parts.length === 1) return parts[0];
  const of = (key) => concatenated(parts.map((part) => part[key]));
  let [texels, hidden] = [0, 0];
  for (const part of parts) {
    for (let i = 0; i < part.layers.count; i++) {
      part.layers.firstTexel[i] += texels;
      part.layers.firstHidden[i] += hidden;
    }
    texels += part.classes.length;
    hidden += part.hidden.length / 3;
  }
  const layers = {};
  for (const key of Object.keys(parts[0].layers)) {
    if (key !== 'count') layers[key] = concatenated(parts.map((part) => part.layers[key]));
  }
  layers.count = layers.a.length;
  return { layers, classes: of('classes'), alpha: of('alpha'), hidden: of('hidden') };
}

function readLayers(tiles, shapes) {
  const n = shapes.length;
  const layers = {
    count: n,
    /** Upper left pixel of the layer's tile. */
    tileX: new Uint32Array(n),
    tileY: new Uint32Array(n),
    /** δ = a + b u + c v. */
    a: new Float64Array(n),
    b: new Float64Array(n),
    c: new Float64Array(n),
    /** Rectangle in photo pixels. */
    x: new Uint32Array(n),
    y: new Uint32Array(n),
    w: new Uint32Array(n),
    h: new Uint32Array(n),
    firstTexel: new Uint32Array(n),
    firstHidden: new Uint32Array(n),
    /** Count of texels from the photo. */
    visible: new Uint32Array(n),
    /** 1 where any texel is not opaque, so that the layer has a soft edge. */
    soft: new Uint8Array(n),
  };
  const texels = shapes.reduce((sum, { w, h }) => sum + w * h, 0);
  const classes = new Uint8Array(texels);
  const alpha = new Uint8Array(texels);
  let texel = 0;
  shapes.forEach((shape, i) => {
    const own = tiles[shape.tile].rect;
    layers.tileX[i] = own.x;
    layers.tileY[i] = own.y;
    for (const key of ['a', 'b', 'c']) layers[key][i] = shape.plane[key];
    for (const key of ['x', 'y', 'w', 'h']) layers[key][i] = shape[key];
    layers.firstTexel[i] = texel;
    classes.set(shape.classes, texel);
    alpha.set(shape.alpha, texel);
    texel += shape.w * shape.h;
  });
  return { layers, classes, alpha };
}

/** Fills `layers.visible`, `layers.soft` and `layers.firstHidden`; gives the count of hidden texels. */
function describeLayers({ layers, classes, alpha }) {
  let hidden = 0;
  for (let i = 0; i < layers.count; i++) {
    const first = layers.firstTexel[i];
    const end = first + layers.w[i] * layers.h[i];
    let visible = 0;
    let soft = 0;
    layers.firstHidden[i] = hidden;
    for (let k = first; k < end; k++) {
      if (classes[k] === Class.PHOTO) visible++;
      else if (classes[k] === Class.HIDDEN) hidden++;
      if (alpha[k] < 255) soft = 1;
    }
    layers.visible[i] = visible;
    layers.soft[i] = soft;
  }
  return hidden;
}

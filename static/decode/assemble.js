// Decodes a container in bands and joins their layers into the scene that the page uploads and draws.
import { mirrorFlags, pieces as piecesOf } from '../draw/border.js';
import { floatsFit } from '../draw/deep-stacks.js';
import { instances } from '../draw/instances.js';
import { pack } from '../draw/texture-atlas.js';
import { margins } from '../view/camera-limits.js';
import { tileCounts } from './grid.js';

/** @import { Piece } from '../draw/border.js' */
/** @import { Band as Strip } from '../draw/texture-atlas.js' */
/** @import { Band, BandJob, StripJob } from './band.js' */
/** @import { Head } from './head.js' */
/** @import { Layers, Picture, Scene, SceneHead } from './scene.js' */

/** @typedef {Pick<Band, 'decode' | 'deep' | 'strips'>} Helper a band in this worker or another one */

/** Side of the blocks of pixels of which a band's photo must have all: crates/core's `BLOCK`. */
const BLOCK = 32;

/**
 * @param {Pick<Head, 'scene' | 'reach'>} head
 * @param {{bytes: Uint8Array, photo: Picture, hidden: Picture | null}} input
 * @param {Helper[]} bands
 * @param {number} [side] of the graphics device's largest texture
 * @returns {Promise<{scene: Omit<Scene, 'decodeMs'>, transfer: ArrayBuffer[]}>} `transfer`: the scene's buffers, to be transferred with it
 */
export async function assembled({ scene, reach }, input, bands, side) {
  const jobs = cut(scene, reach, input, bands.length);
  // `together` starts the other workers first, because the first band is decoded here
  const tables = await together(bands.slice(0, jobs.length), (band, i) => band.decode(jobs[i]));
  const layers = joined(tables);
  const whole = { ...scene, layers };
  const pieces = piecesOf(whole);
  const starts = tables.map((_, i) => tables.slice(0, i).reduce((sum, { count }) => sum + count, 0));
  const groups = pieces.map(({ layer }) => starts.findLastIndex((start) => layer >= start));
  const places = pack(pieces, groups, side);
  const wide = floatsFit(places) && (await anyDeep(scene, pieces, starts, bands.slice(0, jobs.length)));
  const strips = places.bands.map((band) => ({ ...band, group: groups[band.pieces[0]] }));
  const filled = await together(bands.slice(0, jobs.length), (band, i) =>
    band.strips({
      jobs: strips.filter(({ group }) => group === i).map((strip) => stripJob(strip, pieces, starts[i], places.width)),
      wide,
    }),
  );
  // each group's strips stay in their order
  const next = filled.map(() => 0);
  const atlas = {
    width: places.width,
    height: places.height,
    pages: places.pages,
    wide,
    strips: strips.map(({ page, y, h, group }) => ({ page, y, h, data: filled[group][next[group]++].data })),
  };
  const drawn = instances(whole, pieces, places);
  const arrays = [...Object.values(layers), drawn.data, drawn.tiles, ...atlas.strips.map(({ data }) => data)];
  const transfer = arrays.filter((a) => ArrayBuffer.isView(a)).map((a) => /** @type {ArrayBuffer} */ (a.buffer));
  return { scene: { ...whole, instances: drawn, atlas }, transfer };
}

/**
 * Whether any band has deep stacks of soft texels. Bands number their layers from their first one.
 * @param {SceneHead} scene
 * @param {Piece[]} pieces
 * @param {number[]} starts first layer of each band
 * @param {Helper[]} bands
 */
async function anyDeep({ width, height }, pieces, starts, bands) {
  const own = bands.map(() => /** @type {Piece[]} */ ([]));
  for (const piece of pieces) {
    const i = starts.findLastIndex((start) => piece.layer >= start);
    own[i].push({ ...piece, layer: piece.layer - starts[i] });
  }
  const deep = await together(bands, (band, i) => band.deep({ width, height, pieces: own[i] }));
  return deep.some(Boolean);
}

/**
 * Calls all bands, the last one first, and returns their results in order.
 * @template T
 * @param {Helper[]} bands
 * @param {(band: Helper, i: number) => Promise<T>} call
 */
async function together(bands, call) {
  /** @type {Promise<T>[]} */
  const begun = [];
  for (let i = bands.length - 1; i >= 0; i--) begun[i] = call(bands[i], i);
  return Promise.all(begun);
}

/**
 * Splits the rows of tiles evenly into bands.
 * @param {SceneHead} scene
 * @param {number} reach rows of pixels above and below a tile that its layers depend on
 * @param {{bytes: Uint8Array, photo: Picture, hidden: Picture | null}} input
 * @param {number} count most bands
 * @returns {BandJob[]}
 */
function cut(scene, reach, { bytes, photo, hidden }, count) {
  const { columns, tiles } = tileCounts(scene);
  const rows = tiles / columns;
  const bands = Math.min(count, rows);
  const margin = margins(scene).y;
  return Array.from({ length: bands }, (_, i) => {
    const [first, end] = [Math.floor((i * rows) / bands), Math.floor(((i + 1) * rows) / bands)];
    const [from, to] = [first * scene.tileStride, (end - 1) * scene.tileStride + scene.tileSize];
    // texels that are mirrored beyond the upper or lower border take the colours at that border
    const top = from < margin ? 0 : Math.max(Math.floor((from - reach) / BLOCK) * BLOCK, 0);
    const bottom = to > photo.height - margin ? photo.height : Math.min(Math.ceil((to + reach) / BLOCK) * BLOCK, photo.height);
    const stride = photo.width * 4;
    // the band in this worker shares the picture; the others get copies to transfer
    const data = i === 0 ? photo.data.subarray(0, bottom * stride) : photo.data.slice(top * stride, bottom * stride);
    return { scene, bytes, first, end, top, photo: { ...photo, data }, hidden };
  });
}

/**
 * Joins the tables of all bands.
 * @param {Layers[]} tables
 * @returns {Layers}
 */
function joined(tables) {
  if (tables.length === 1) return tables[0];
  const count = tables.reduce((sum, table) => sum + table.count, 0);
  /**
   * @template {Float64Array | Uint32Array | Uint8Array} Column
   * @param {Column} out
   * @param {(table: Layers) => Column} of
   */
  const column = (out, of) => {
    let at = 0;
    for (const table of tables) {
      out.set(of(table), at);
      at += table.count;
    }
    return out;
  };
  /** @param {'a' | 'b' | 'c'} key */
  const floats = (key) => column(new Float64Array(count), (table) => table[key]);
  /** @param {'x' | 'y' | 'w' | 'h' | 'tileX' | 'tileY' | 'visible'} key */
  const integers = (key) => column(new Uint32Array(count), (table) => table[key]);
  return {
    count,
    a: floats('a'),
    b: floats('b'),
    c: floats('c'),
    x: integers('x'),
    y: integers('y'),
    w: integers('w'),
    h: integers('h'),
    tileX: integers('tileX'),
    tileY: integers('tileY'),
    visible: integers('visible'),
    soft: column(new Uint8Array(count), (table) => table.soft),
  };
}

/**
 * Arguments of `Decoder.strip` for a strip; layers count from the band's first.
 * @param {Pick<Strip, 'pieces' | 'x' | 'h'>} strip
 * @param {Piece[]} pieces
 * @param {number} start the band's first layer
 * @param {number} width of a page
 * @returns {StripJob}
 */
function stripJob({ pieces: own, x, h }, pieces, start, width) {
  const numbers = own.flatMap((i, k) => {
    const { layer, u, v, w, h } = pieces[i];
    return [layer - start, u, v, w, h, mirrorFlags(pieces[i]), x[k]];
  });
  return { pieces: Uint32Array.from(numbers), width, height: h };
}

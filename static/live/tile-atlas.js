// Places the layers of a room's tiles on texture pages. Each layer has its own cell, so that a changed tile moves no other tile. The
// continuation of a layer beyond the picture's border uses the same texels, backward, for its shape; its colours come from the means along
// the border, below the cells of the first page (draw/tmpi.wgsl).

import { tileCounts } from '../decode/grid.js';
import { pieces as piecesOf } from '../draw/border.js';
import { instances } from '../draw/instances.js';

/** @import { Layers, SceneHead } from '../decode/scene.js' */
/** @import { Piece } from '../draw/border.js' */
/** @import { Instances } from '../draw/instances.js' */
/** @import { ChangedTile } from './decoder.js' */

/**
 * Texels of pieces, one piece after another, then the border's means, and five numbers for each: page, x, y, width and height.
 * @typedef {{data: Uint8Array<ArrayBuffer>, places: Uint32Array<ArrayBuffer>}} Cells
 */
/**
 * In `pieces`, layers count from the tile's first; `cells` has one per layer.
 * @typedef {{layers: Float64Array[], pieces: Piece[], cells: number[]}} Tile
 */

/** Largest side of a page. */
const PAGE_SIDE = 2048;
/** Initial count of cells: so many per tile, plus a reserve. */
const CELLS_PER_TILE = 6;
const RESERVE = 32;
/** Rows of the border's means, as in tmpi.wgsl. */
const BORDER_ROWS = 28;

export class TileAtlas {
  #head;
  #columns;
  /** @type {Tile[]} */
  #tiles;
  /** @type {number[]} */
  #free = [];
  #columnsPerPage = 0;
  #rowsPerPage = 0;
  #maxColumns;
  #maxRows;

  /**
   * @param {SceneHead} head
   * @param {number} side of the largest texture
   */
  constructor(head, side) {
    this.#head = head;
    const { columns, tiles } = tileCounts(head);
    this.#columns = columns;
    this.#tiles = Array.from({ length: tiles }, () => ({ layers: [], pieces: [], cells: [] }));
    const most = Math.min(PAGE_SIDE, side);
    this.#maxColumns = Math.max(1, Math.floor(most / head.tileSize));
    this.#maxRows = Math.max(1, Math.floor((most - BORDER_ROWS) / head.tileSize));
    this.#reserve(tiles * CELLS_PER_TILE + RESERVE);
  }

  /** @param {number} count of cells */
  #reserve(count) {
    this.#columnsPerPage = Math.min(this.#maxColumns, Math.ceil(Math.sqrt(count)));
    this.#rowsPerPage = Math.min(this.#maxRows, Math.ceil(count / this.#columnsPerPage));
    this.pages = Math.ceil(count / (this.#columnsPerPage * this.#rowsPerPage));
    const all = this.#columnsPerPage * this.#rowsPerPage * this.pages;
    this.#free = Array.from({ length: all }, (_, i) => all - 1 - i);
  }

  /** Size of a page. */
  get size() {
    const { tileSize } = this.#head;
    return { width: this.#columnsPerPage * tileSize, height: this.#rowsPerPage * tileSize + BORDER_ROWS };
  }

  /** Columns of the border's means: one for each pixel of the longest border and one more, or as many as a page has. */
  get borderColumns() {
    const { width, height } = this.#head;
    return Math.min(Math.max(width, height) + 1, this.size.width);
  }

  /**
   * Applies changed tiles; returns the layers whose texels must be written, and their places and that of the border's means. `grown`: the
   * cells ran out, and all tiles have new places on larger pages.
   * @param {ChangedTile[]} changed
   */
  change(changed) {
    const reshaped = changed.filter(({ layers }) => layers);
    let grown = false;
    if (reshaped.length) {
      this.#shape(reshaped);
      for (const { tile } of reshaped) this.#free.push(...this.#tiles[tile].cells.splice(0));
      let need = reshaped.reduce((sum, { tile }) => sum + this.#tiles[tile].layers.length, 0);
      if (need > this.#free.length) {
        grown = true;
        need = this.#tiles.reduce((sum, { layers }) => sum + layers.length, 0);
        this.#reserve(2 * need);
        for (const tile of this.#tiles) tile.cells = [];
      }
      for (const tile of this.#tiles)
        while (tile.cells.length < tile.layers.length) tile.cells.push(/** @type {number} */ (this.#free.pop()));
    }
    const wanted = grown ? this.#tiles.map((_, tile) => tile) : changed.map(({ tile }) => tile);
    return { ...this.#fill(wanted), reshaped: reshaped.length > 0, grown };
  }

  /** All layers, in the form of `change`. */
  all() {
    return this.#fill(this.#tiles.map((_, tile) => tile));
  }

  /** @param {number[]} wanted tiles */
  #fill(wanted) {
    /** @type {number[]} */
    const numbers = [];
    /** @type {number[]} */
    const places = [];
    for (const tile of wanted) {
      const { pieces, cells } = this.#tiles[tile];
      for (const { layer, w, h } of pieces.filter(({ flipX, flipY }) => !flipX && !flipY)) {
        numbers.push(tile, layer);
        const { page, x, y } = this.#place(cells[layer]);
        places.push(page, x, y, w, h);
      }
    }
    places.push(0, 0, this.size.height - BORDER_ROWS, this.borderColumns, BORDER_ROWS);
    return { numbers: Uint32Array.from(numbers), places: Uint32Array.from(places) };
  }

  /** @param {number} cell */
  #place(cell) {
    const { tileSize } = this.#head;
    const page = Math.floor(cell / (this.#columnsPerPage * this.#rowsPerPage));
    const rest = cell - page * this.#columnsPerPage * this.#rowsPerPage;
    return { page, x: (rest % this.#columnsPerPage) * tileSize, y: Math.floor(rest / this.#columnsPerPage) * tileSize };
  }

  /**
   * Splits the layers of tiles into drawn pieces.
   * @param {ChangedTile[]} reshaped
   */
  #shape(reshaped) {
    const rows = reshaped.flatMap(({ tile, layers }) => (layers ?? []).map((row) => ({ tile, row })));
    for (const { tile, layers } of reshaped) Object.assign(this.#tiles[tile], { layers: layers ?? [], pieces: [] });
    const starts = new Map();
    rows.forEach(({ tile }, i) => starts.has(tile) || starts.set(tile, i));
    for (const piece of piecesOf({ ...this.#head, layers: this.#table(rows) })) {
      const { tile } = rows[piece.layer];
      this.#tiles[tile].pieces.push({ ...piece, layer: piece.layer - starts.get(tile) });
    }
  }

  /**
   * @param {{tile: number, row: Float64Array}[]} rows
   * @returns {Layers}
   */
  #table(rows) {
    const { tileStride } = this.#head;
    const floats = (/** @type {number} */ at) => Float64Array.from(rows, ({ row }) => row[at]);
    const whole = (/** @type {number} */ at) => Uint32Array.from(rows, ({ row }) => row[at]);
    return {
      count: rows.length,
      a: floats(0),
      b: floats(1),
      c: floats(2),
      x: whole(3),
      y: whole(4),
      w: whole(5),
      h: whole(6),
      tileX: Uint32Array.from(rows, ({ tile }) => (tile % this.#columns) * tileStride),
      tileY: Uint32Array.from(rows, ({ tile }) => Math.floor(tile / this.#columns) * tileStride),
      visible: whole(7),
      soft: Uint8Array.from(rows, ({ row }) => row[8]),
    };
  }

  /**
   * The layers of all tiles, and the instances that draw them.
   * @returns {{layers: Layers, instances: Instances}}
   */
  drawn() {
    const layers = this.#table(this.#tiles.flatMap(({ layers }, tile) => layers.map((row) => ({ tile, row }))));
    /** @type {Piece[]} */
    const pieces = [];
    const [page, atlasX, atlasY] = [[], [], []].map((list) => /** @type {number[]} */ (list));
    let first = 0;
    for (const tile of this.#tiles) {
      for (const piece of tile.pieces) {
        const { layer, u, v, w, h, flipX, flipY } = piece;
        pieces.push({ ...piece, layer: layer + first });
        const place = this.#place(tile.cells[layer]);
        page.push(place.page);
        atlasX.push(flipX ? -(place.x + u + w) : place.x + u);
        atlasY.push(flipY ? -(place.y + v + h) : place.y + v);
      }
      first += tile.layers.length;
    }
    return { layers, instances: instances({ ...this.#head, layers }, pieces, { page, atlasX, atlasY }) };
  }
}

// Where the layers of a room's tiles lie on the texture pages: each layer in a square of its own, so that a tile that changes moves no
// other. What continues a layer beyond the picture's border is drawn of the same texels, backward.

import { tileCounts } from '../decode/grid.js';
import { pieces as piecesOf } from '../draw/border.js';
import { instances } from '../draw/instances.js';

/** @import { Layers, SceneHead } from '../decode/scene.js' */
/** @import { Piece } from '../draw/border.js' */
/** @import { Instances } from '../draw/instances.js' */
/** @import { ChangedTile } from './decoder.js' */

/**
 * Texels of pieces, one after the other, and where they go on the pages: page, x, y, width and height of each, five numbers.
 * @typedef {{data: Uint8Array<ArrayBuffer>, places: Uint32Array<ArrayBuffer>}} Cells
 */
/** @typedef {{layers: Float64Array[], pieces: Piece[], cells: number[]}} Tile pieces count layers from the tile's first; a cell for each layer */

/** Side of a page at most. */
const PAGE_SIDE = 2048;
/** Squares that there are for each tile at first, and beside these. */
const PER_TILE = 6;
const MORE = 32;

export class TileAtlas {
  #head;
  #columns;
  /** @type {Tile[]} */
  #tiles;
  /** @type {number[]} */
  #free = [];
  #across = 0;
  #down = 0;

  /**
   * @param {SceneHead} head
   * @param {number} side of the largest texture
   */
  constructor(head, side) {
    this.#head = head;
    const { columns, tiles } = tileCounts(head);
    this.#columns = columns;
    this.#tiles = Array.from({ length: tiles }, () => ({ layers: [], pieces: [], cells: [] }));
    this.#most = Math.max(1, Math.floor(Math.min(PAGE_SIDE, side) / head.tileSize));
    this.#reserve(tiles * PER_TILE + MORE);
  }

  #most;

  /** @param {number} count of squares */
  #reserve(count) {
    this.#across = Math.min(this.#most, Math.ceil(Math.sqrt(count)));
    this.#down = Math.min(this.#most, Math.ceil(count / this.#across));
    this.pages = Math.ceil(count / (this.#across * this.#down));
    const all = this.#across * this.#down * this.pages;
    this.#free = Array.from({ length: all }, (_, i) => all - 1 - i);
  }

  /** Size of a page. */
  get size() {
    const { tileSize } = this.#head;
    return { width: this.#across * tileSize, height: this.#down * tileSize };
  }

  /**
   * Takes over tiles that changed; gives which layers are to be filled anew, and where they go. `grown`: there was no place left, and
   * all tiles have new places on larger pages.
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

  /** All layers, as `change` gives them. */
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
    return { numbers: Uint32Array.from(numbers), places: Uint32Array.from(places) };
  }

  /** @param {number} cell */
  #place(cell) {
    const { tileSize } = this.#head;
    const page = Math.floor(cell / (this.#across * this.#down));
    const rest = cell - page * this.#across * this.#down;
    return { page, x: (rest % this.#across) * tileSize, y: Math.floor(rest / this.#across) * tileSize };
  }

  /**
   * Cuts the layers of tiles into the pieces that are drawn.
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
   * Layers of all tiles, and the instances that draw them.
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

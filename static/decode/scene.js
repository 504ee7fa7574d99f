// Types of a decoded scene. Lengths are in photo pixels unless stated otherwise.

export {};

/** @typedef {{fx: number, fy: number, cx: number, cy: number}} Intrinsics */
/** @typedef {{x: number, y: number, z: number}} Offset along the camera's axes: right, down, forward */

/**
 * The part of a scene that is known before its layers are decoded.
 * @typedef {object} SceneHead
 * @property {number} width
 * @property {number} height
 * @property {number} tileSize side of a tile
 * @property {number} tileStride distance from one tile to the next
 * @property {Intrinsics} intrinsics of the reference camera
 * @property {Offset} viewBox half extents, in units of the nearest distance
 */

/**
 * Layers, with one element per layer in every array: plane δ = a + b·u + c·v over the tile, rectangle, corner of its tile, count of
 * visible texels, and whether any texel is soft.
 * @typedef {object} Layers
 * @property {number} count
 * @property {Float64Array} a
 * @property {Float64Array} b
 * @property {Float64Array} c
 * @property {Uint32Array} x
 * @property {Uint32Array} y
 * @property {Uint32Array} w
 * @property {Uint32Array} h
 * @property {Uint32Array} tileX
 * @property {Uint32Array} tileY
 * @property {Uint32Array} visible
 * @property {Uint8Array} soft
 */

/** @typedef {{width: number, height: number, data: Uint8Array | Uint8ClampedArray}} Picture straight RGBA */

/** @import { Instances } from '../draw/instances.js' */
/** @import { Atlas } from '../draw/texture-atlas.js' */

/**
 * A scene ready to draw, and the decoding time.
 * @typedef {SceneHead & {layers: Layers, instances: Instances, atlas: Atlas, decodeMs: number}} Scene
 */

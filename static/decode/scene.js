// A decoded scene: what the decoder gives, and what is drawn. Lengths are in pixels of the photo unless they say otherwise.

export {};

/** @typedef {{fx: number, fy: number, cx: number, cy: number}} Intrinsics */
/** @typedef {{x: number, y: number, z: number}} Offset three numbers along the camera's axes: right, down, forward */

/**
 * What is known of a scene before its layers are there.
 * @typedef {object} SceneHead
 * @property {number} width
 * @property {number} height
 * @property {number} tileSize side of a tile
 * @property {number} tileStride from one tile to the next
 * @property {Intrinsics} intrinsics of the photo's camera
 * @property {Offset} viewBox half extents, in units of the nearest distance
 */

/**
 * Layers, one number each in every array: plane δ = a + b·u + c·v over the tile, rectangle, corner of its tile, count of visible
 * texels, and whether any texel is soft.
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
 * All of a scene as it is drawn, and the time that decoding took.
 * @typedef {SceneHead & {layers: Layers, instances: Instances, atlas: Atlas, decodeMs: number}} Scene
 */

// Cameras and poses: the arithmetic of crates/core's `Pose` and `Camera`, and framing a photo on a page.
// x right, y down, z forward; lengths in units of the nearest distance; angles in degrees.

/** @import { Intrinsics, Offset, Scene, SceneHead } from '../decode/scene.js' */

/** @typedef {{tx: number, ty: number, tz: number, yaw: number, pitch: number, roll: number}} Pose */
/**
 * A camera and the viewport of its picture on a canvas; `mask`: the colour channels that it draws, as bits (1 red, 2 green, 4 blue), by
 * default all.
 * @typedef {{pose: Pose, k: Intrinsics, x: number, y?: number, width: number, height: number, mask?: number}} View
 */

/** @type {Readonly<Pose>} */
export const HOME = Object.freeze({ tx: 0, ty: 0, tz: 0, yaw: 0, pitch: 0, roll: 0 });
export const POSE_KEYS = Object.freeze(/** @type {(keyof Pose)[]} */ (Object.keys(HOME)));

const RADIANS = Math.PI / 180;

/**
 * @param {number[]} a
 * @param {number[]} b
 */
function multiply(a, b) {
  const out = [];
  for (let i = 0; i < 3; i++) {
    for (let j = 0; j < 3; j++) out.push(a[i * 3] * b[j] + a[i * 3 + 1] * b[3 + j] + a[i * 3 + 2] * b[6 + j]);
  }
  return out;
}

/**
 * `{r, t}` with `X_t = R X + t`; `r` row-major.
 * @param {Pose} pose
 */
export function extrinsics(pose) {
  const [sy, cy] = [Math.sin(pose.yaw * RADIANS), Math.cos(pose.yaw * RADIANS)];
  const [sp, cp] = [Math.sin(pose.pitch * RADIANS), Math.cos(pose.pitch * RADIANS)];
  const [sr, cr] = [Math.sin(pose.roll * RADIANS), Math.cos(pose.roll * RADIANS)];
  const ry = [cy, 0, sy, 0, 1, 0, -sy, 0, cy];
  const rx = [1, 0, 0, 0, cp, -sp, 0, sp, cp];
  const rz = [cr, -sr, 0, sr, cr, 0, 0, 0, 1];
  const c = multiply(multiply(ry, rx), rz);
  const r = [c[0], c[3], c[6], c[1], c[4], c[7], c[2], c[5], c[8]];
  const t = [0, 1, 2].map((i) => -(r[i * 3] * pose.tx + r[i * 3 + 1] * pose.ty + r[i * 3 + 2] * pose.tz));
  return { r, t };
}

/**
 * The same camera at another picture size, with the same horizontal field of view.
 * @param {Intrinsics} k
 * @param {{width: number, height: number}} from
 * @param {{width: number, height: number}} to
 */
export function resized(k, from, to) {
  const s = to.width / from.width;
  return {
    fx: k.fx * s,
    fy: k.fy * s,
    cx: to.width / 2 + (k.cx - from.width / 2) * s,
    cy: to.height / 2 + (k.cy - from.height / 2) * s,
  };
}

/**
 * The part of a photo that a picture shows: the photo's width in units of the picture's width, and the point at the picture's centre, in
 * shares of the photo's width and height.
 * @typedef {{scale: number, x: number, y: number}} Frame
 */

/** @type {Readonly<Frame>} */
export const WHOLE = Object.freeze({ scale: 1, x: 0.5, y: 0.5 });

/**
 * The camera for a picture of size `to` that shows a part of the photo.
 * @param {SceneHead} head
 * @param {{width: number, height: number}} to
 * @param {Frame} frame
 * @returns {Intrinsics}
 */
export function framed({ intrinsics: k, width, height }, to, { scale, x, y }) {
  const s = (to.width * scale) / width;
  return { fx: k.fx * s, fy: k.fy * s, cx: (k.cx - x * width) * s + to.width / 2, cy: (k.cy - y * height) * s + to.height / 2 };
}

/**
 * Magnifies a frame by a factor about a fixed point.
 * @param {Frame} frame
 * @param {number} by
 * @param {{x: number, y: number}} place
 * @returns {Frame}
 */
export function magnified({ scale, x, y }, by, place) {
  return { scale: scale * by, x: place.x + (x - place.x) / by, y: place.y + (y - place.y) / by };
}

/**
 * Horizontal field of view in degrees.
 * @param {Intrinsics} k
 * @param {number} width
 */
export function fovX(k, width) {
  return (2 * Math.atan(width / 2 / k.fx)) / RADIANS;
}

/**
 * `m` of layer `i`, with `δ = mᵀ(x, y, 1)` in normalised image coordinates.
 * @param {Scene} scene
 * @param {number} i
 */
export function normalOf(scene, i) {
  const { layers, intrinsics: k } = scene;
  const half = scene.tileSize / 2;
  const bx = layers.b[i] / half;
  const by = layers.c[i] / half;
  const cx = layers.tileX[i] + half;
  const cy = layers.tileY[i] + half;
  return [bx * k.fx, by * k.fy, layers.a[i] + bx * (k.cx - cx) + by * (k.cy - cy)];
}

/**
 * A camera at an offset that keeps looking at the centre of the scene: it rotates against its own translation, so that points at disparity
 * `pivot` stay in place.
 * @param {number} pivot
 * @param {number} tx
 * @param {number} ty
 * @param {number} tz
 */
export function lookingAt(pivot, tx, ty, tz) {
  const depth = 1 - tz * pivot;
  const yaw = -Math.atan2(tx * pivot, depth) / RADIANS;
  const pitch = Math.atan2(ty * pivot, Math.hypot(depth, tx * pivot)) / RADIANS;
  return { tx, ty, tz, yaw, pitch, roll: 0 };
}

/**
 * δ of layer `i` at a reference pixel.
 * @param {Pick<Scene, 'layers' | 'tileSize'>} scene
 * @param {number} i
 * @param {number} x
 * @param {number} y
 */
export function deltaAt({ layers, tileSize }, i, x, y) {
  const half = tileSize / 2;
  return layers.a[i] + (layers.b[i] * (x - layers.tileX[i] - half)) / half + (layers.c[i] * (y - layers.tileY[i] - half)) / half;
}

/** Distance between the eyes in units of the nearest distance, as in the server's stereo views. */
export const EYES = 1 / 30;
/** Most parallax between the eyes, as a share of the view's width: more strains them. */
const COMFORT = 0.03;

const [RED, GREEN, BLUE] = [1, 2, 4];
/**
 * For each stereo layout of the server that the browser draws, the column and the channels of the left and of the right eye's view.
 * @type {Record<string, {column: number, mask?: number}[]>}
 */
const LAYOUTS = {
  sbs: [{ column: 0 }, { column: 1 }],
  crossed: [{ column: 1 }, { column: 0 }],
  anaglyph: [RED, GREEN | BLUE].map((mask) => ({ column: 0, mask })),
  'anaglyph-green-magenta': [GREEN, RED | BLUE].map((mask) => ({ column: 0, mask })),
  'anaglyph-amber-blue': [RED | GREEN, BLUE].map((mask) => ({ column: 0, mask })),
};

/**
 * Number of views beside each other.
 * @param {string} layout a stereo layout, or '' for one view
 */
export const columnsOf = (layout) => Math.max(...(LAYOUTS[layout] ?? [{ column: 0 }]).map(({ column }) => column)) + 1;

/**
 * The views of both eyes on a canvas of `size`, and whether the eyes are closer together than asked because more parallax would strain
 * them. Points at disparity `focus` appear at the depth of the screen.
 * @param {Pose} pose
 * @param {SceneHead} head
 * @param {{width: number, height: number}} size
 * @param {number} focus
 * @param {Frame} frame
 * @param {{layout: string, distance: number}} stereo `distance`: between the eyes, in units of the nearest distance
 */
export function eyes(pose, head, size, focus, frame, { layout, distance }) {
  const [width, height] = [Math.floor(size.width / columnsOf(layout)), size.height];
  const k = framed(head, { width, height }, frame);
  // the nearest disparity is 1, the farthest 0
  const most = (COMFORT * width) / (k.fx * Math.max(focus, 1 - focus));
  const apart = Math.min(distance, most);
  const views = LAYOUTS[layout].map(({ column, mask }, i) =>
    shifted({ pose, k, x: column * width, width, height, mask }, [(i - 0.5) * apart, 0], focus),
  );
  return { views, narrowed: distance > most };
}

/**
 * The view of a camera shifted to its right and down; points at disparity `focus` stay in place.
 * @template {{pose: Pose, k: Intrinsics}} V
 * @param {V} view
 * @param {number[]} place
 * @param {number} focus
 * @returns {V}
 */
export function shifted(view, [right, down], focus) {
  const { pose, k } = view;
  const { r } = extrinsics(pose);
  const worldShift = (/** @type {number} */ i) => r[i] * right + r[3 + i] * down;
  return {
    ...view,
    pose: { ...pose, tx: pose.tx + worldShift(0), ty: pose.ty + worldShift(1), tz: pose.tz + worldShift(2) },
    k: { ...k, cx: k.cx + k.fx * right * focus, cy: k.cy + k.fy * down * focus },
  };
}

/**
 * Angles of a pose whose camera-to-world rotation is `c`, row-major.
 * @param {number[]} c
 */
export function anglesOf(c) {
  const sine = Math.max(-1, Math.min(1, -c[5]));
  const [pitch, yaw] = [Math.asin(sine), Math.atan2(c[2], c[8])];
  // looking straight up or down, yaw and roll are the same axis
  const atPole = Math.abs(sine) > 1 - 1e-9;
  const angles = atPole ? [Math.atan2(-c[6], c[0]), pitch, 0] : [yaw, pitch, Math.atan2(c[3], c[4])];
  const [y, p, r] = angles.map((v) => v / RADIANS);
  return { yaw: y, pitch: p, roll: r };
}

/**
 * Parses `tx,ty,tz[,yaw,pitch,roll]`; null if the text is not a pose.
 * @param {string} text
 */
export function parsePose(text) {
  const parts = text.split(',');
  if (parts.length !== 3 && parts.length !== 6) return null;
  const pose = { ...HOME };
  for (let i = 0; i < parts.length; i++) {
    const value = parts[i].trim() === '' ? NaN : Number(parts[i]);
    if (!Number.isFinite(value)) return null;
    pose[POSE_KEYS[i]] = value;
  }
  return pose;
}

/**
 * Formats a pose with up to four decimals.
 * @param {Partial<Pose>} pose
 */
export function formatPose(pose) {
  const rounded = (/** @type {number} */ v) => String(Math.round(v * 1e4) / 1e4 || 0);
  const keys = pose.yaw || pose.pitch || pose.roll ? POSE_KEYS : POSE_KEYS.slice(0, 3);
  return keys.map((key) => rounded(pose[key] ?? 0)).join(',');
}

// The modules that the element fetches when it first shows something.

/** All modules of the viewer, fetched at once and not one import after another. */
export const MODULES = [
  'decode/grid.js',
  'decode/problem.js',
  'decode/start.js',
  'draw/backends.js',
  'draw/depth-of-field/aperture.js',
  'draw/depth-of-field/mean-webgl.js',
  'draw/depth-of-field/mean-webgpu.js',
  'draw/device.js',
  'draw/glsl.js',
  'draw/instances.js',
  'draw/server-views.js',
  'draw/texture-atlas.js',
  'draw/tile-errors.js',
  'draw/view-uniform.js',
  'draw/webgl-contexts.js',
  'draw/webgl-copy.js',
  'draw/webgl-program.js',
  'draw/webgl-target.js',
  'draw/webgl.js',
  'draw/webgpu-copy.js',
  'draw/webgpu.js',
  'element/photo-addresses.js',
  'element/signed-link.js',
  'input/camera-motion.js',
  'input/camera-position.js',
  'input/gestures.js',
  'input/gyroscope.js',
  'input/zoom.js',
  'view/adaptive-resolution.js',
  'view/camera-limits.js',
  'view/camera.js',
  'view/canvas-size.js',
  'view/detail.js',
  'view/draw-mode.js',
  'view/live-view.js',
  'view/motion-range.js',
  'view/settings.js',
  'view/stage.js',
  'view/viewer-state.js',
  'view/viewer.js',
];
/** Additional modules for rooms. */
export const ROOM_MODULES = [
  'element/room.js',
  'element/style-sheet.js',
  'i18n/element.js',
  'i18n/messages.js',
  'live/room-address.js',
  'live/room-status.js',
  'live/sound-player.js',
  'live/start.js',
];

/** @type {Set<string>} */
const preloaded = new Set();

/**
 * Preloads modules, each once per page.
 * @param {string[]} modules
 */
export function preload(modules) {
  for (const name of modules.filter((name) => !preloaded.has(name))) {
    preloaded.add(name);
    const link = document.createElement('link');
    link.rel = 'modulepreload';
    link.href = new URL(`../${name}`, import.meta.url).href;
    document.head.append(link);
  }
}

/**
 * A module below static/.
 * @param {string} name
 */
export const load = (name) => import(new URL(`../${name}`, import.meta.url).href);

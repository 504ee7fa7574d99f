// Pairs photos with their depth maps by file name.

/** End of the name of a depth map, without its extension: photo_depth, photo-depthmap, photo.disparity. */
const MAP = /^(?<photo>.+)[-_. ](?:depth[-_ ]?(?:map)?|disparity|disp)$/i;

/** @param {File} file */
const stem = (file) => file.name.replace(/\.[^.]*$/, '').toLowerCase();

/** @typedef {{file: File, folder?: unknown}} Found a file, and a value that identifies its folder */

/**
 * Each photo with its depth map, in the order of the photos. A map belongs to the first photo of its name in its own folder. A map without
 * a photo is a photo like any other.
 * @param {Found[]} found
 * @returns {{file: File, depth: File | null, second?: File}[]}
 */
export function pairs(found) {
  /** The first photo of each name in each folder. @type {Map<unknown, Map<string, File>>} */
  const folders = new Map();
  for (const { file, folder } of found) {
    const photos = folders.get(folder) ?? new Map();
    if (!photos.has(stem(file))) photos.set(stem(file), file);
    folders.set(folder, photos);
  }
  /** @type {Set<File>} */
  const maps = new Set();
  /** @type {Map<File, File>} */
  const depths = new Map();
  for (const { file: map, folder } of found) {
    const photo = folders.get(folder)?.get(MAP.exec(stem(map))?.groups?.photo ?? '');
    if (!photo) continue;
    // of several maps of a photo only the first counts; the others are not photos either
    maps.add(map);
    if (!depths.has(photo)) depths.set(photo, map);
  }
  return found.filter(({ file }) => !maps.has(file)).map(({ file }) => ({ file, depth: depths.get(file) ?? null }));
}

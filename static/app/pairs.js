// Photos and the depth maps that come beside them, told by their names.

/** End of the name of a depth map, without its extension: photo_depth, photo-depthmap, photo.disparity. */
const MAP = /^(?<photo>.+)[-_. ](?:depth[-_ ]?(?:map)?|disparity|disp)$/i;

/** @param {File} file */
const stem = (file) => file.name.replace(/\.[^.]*$/, '').toLowerCase();

/**
 * Each photo with its depth map, in the order of the photos; a map whose photo is not among the files is a photo like any other.
 * @param {File[]} files
 * @returns {{file: File, depth: File | null}[]}
 */
export function pairs(files) {
  const photos = new Map(files.map((file) => [stem(file), file]));
  /** @type {Map<File, File>} */
  const maps = new Map();
  for (const map of files) {
    const photo = photos.get(MAP.exec(stem(map))?.groups?.photo ?? '');
    // of several maps of a photo the first is taken, the others are no photos either
    if (photo && photo !== map) maps.set(map, photo);
  }
  return files
    .filter((file) => !maps.has(file))
    .map((file) => ({ file, depth: [...maps].find(([, photo]) => photo === file)?.[0] ?? null }));
}

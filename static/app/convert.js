// Prepares photos for upload: a file that the browser can show and the server cannot read is converted to JPEG here, and so is one that is
// too large. A file that neither can read is rejected before the upload, with advice.

import { formatBytes } from '../i18n/format.js';
import { t } from '../i18n/messages.js';

/** The server's default limits (src/server/limits.rs). */
const MOST_BYTES = 32 * 2 ** 20;
const MOST_PIXELS = 50_000_000;
const MOST_SIDE = 16_384;
/** A file with fewer bytes usually has no more pixels than that, and uploading it to find out is cheap. */
const SMALL_BYTES = 4 * 2 ** 20;
/** JPEG qualities, tried in turn until the file is small enough. */
const QUALITIES = [0.95, 0.88, 0.75];
const HEAD_BYTES = 64;

const TAKEN = new Set(['JPEG', 'PNG', 'WebP']);

/**
 * Kind of a file by its first bytes, regardless of its name; null if unknown.
 * @param {Uint8Array} head
 */
export function kindOf(head) {
  const text = String.fromCharCode(...head);
  if (text.startsWith('\xff\xd8\xff')) return 'JPEG';
  if (text.startsWith('\x89PNG')) return 'PNG';
  if (text.startsWith('RIFF') && text.slice(8, 12) === 'WEBP') return 'WebP';
  if (text.startsWith('GIF8')) return 'GIF';
  if (text.startsWith('BM')) return 'BMP';
  if (text.startsWith('II*\0') || text.startsWith('MM\0*')) return 'TIFF';
  if (text.slice(4, 8) !== 'ftyp') return null;
  // the brand of the file, and those that it is compatible with: `mif1` says nothing of the codec
  const brands = text.slice(8);
  if (/avi[fs]/.test(brands)) return 'AVIF';
  return /hei[cxms]|hev[cx]|mif1|msf1/.test(brands) ? 'HEIC' : 'film';
}

/**
 * Size to which a picture is reduced, keeping its shape; null if it is within the limits.
 * @param {{width: number, height: number}} size
 */
export function reduced({ width, height }) {
  const by = Math.min(1, Math.sqrt(MOST_PIXELS / (width * height)), MOST_SIDE / Math.max(width, height));
  return by < 1 ? { width: Math.max(1, Math.floor(width * by)), height: Math.max(1, Math.floor(height * by)) } : null;
}

/**
 * The file to upload for a photo. Throws an error with a message for people if there is none.
 * @param {File} file
 * @param {(loss: string) => void} converting called before a conversion, which takes a moment, with what it loses, if anything
 * @returns {Promise<File>}
 */
export async function prepared(file, converting) {
  if (!file.size) throw new Error(t('The file is empty.'));
  const kind = kindOf(new Uint8Array(await file.slice(0, HEAD_BYTES).arrayBuffer()));
  if (kind && TAKEN.has(kind)) {
    const size = file.size > SMALL_BYTES ? await sizeOf(file) : null;
    if (file.size <= MOST_BYTES && !(size && reduced(size))) return file;
  }
  if (kind === 'film') throw new Error(t('This is a film, not a photo.'));
  // browsers draw the picture alone
  converting(kind === 'HEIC' || kind === 'JPEG' ? t('If the photo came with depth, it was lost in the conversion.') : '');
  const bitmap = await createImageBitmap(file).catch(() => null);
  // for a small unknown file the server decides
  if (!bitmap && !kind && file.size <= SMALL_BYTES) return file;
  if (!bitmap) throw new Error(unreadable(kind, file));
  try {
    return await encoded(bitmap, file, kind);
  } finally {
    bitmap.close();
  }
}

/**
 * @param {string | null} kind
 * @param {File} file
 */
function unreadable(kind, file) {
  if (kind === 'HEIC')
    return t(
      'This browser cannot read HEIC photos. On the iPhone choose Settings → Camera → Formats → Most Compatible, or save the photo as JPEG.',
    );
  if (kind && TAKEN.has(kind)) return t('The file has {0}; at most {1} can be sent.', formatBytes(file.size), formatBytes(MOST_BYTES));
  return t('This browser cannot read {0}. Save the photo as JPEG, PNG or WebP.', kind ?? t('such files'));
}

/**
 * Size of a picture without decoding its pixels, upright, or null.
 * @param {File} file
 */
async function sizeOf(file) {
  const image = new Image();
  image.src = URL.createObjectURL(file);
  try {
    await new Promise((resolve, reject) => {
      image.onload = resolve;
      image.onerror = reject;
    });
    return { width: image.naturalWidth, height: image.naturalHeight };
  } catch {
    return null;
  } finally {
    URL.revokeObjectURL(image.src);
  }
}

/**
 * The picture (its first frame, if it has several) as a JPEG; as a PNG if it has few colours.
 * @param {ImageBitmap} bitmap
 * @param {File} file
 * @param {string | null} kind
 */
async function encoded(bitmap, file, kind) {
  const { width, height } = reduced(bitmap) ?? bitmap;
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext('2d');
  if (!context) throw new Error(unreadable(kind, file));
  // transparent parts lie over white, as on the server
  context.fillStyle = '#fff';
  context.fillRect(0, 0, width, height);
  context.imageSmoothingQuality = 'high';
  context.drawImage(bitmap, 0, 0, width, height);
  const stem = file.name.replace(/\.[^.]*$/, '') || 'photo';
  if (kind === 'GIF') return new File([await canvas.convertToBlob({ type: 'image/png' })], `${stem}.png`, { type: 'image/png' });
  for (const quality of QUALITIES) {
    const blob = await canvas.convertToBlob({ type: 'image/jpeg', quality });
    if (blob.size <= MOST_BYTES) return new File([blob], `${stem}.jpg`, { type: 'image/jpeg' });
  }
  throw new Error(t('The file has {0}; at most {1} can be sent.', formatBytes(file.size), formatBytes(MOST_BYTES)));
}

// Files of a drop, including those in folders.

/** @import { Found } from './depth-pairs.js' */

/** Maximum number of files of one drop. */
const MOST = 500;

/**
 * All files of a drop with their folders; from folders only pictures. Call it while the event is handled.
 * @param {DataTransfer} transfer
 */
export async function filesOf(transfer) {
  const entries = [...transfer.items].flatMap((item) => item.webkitGetAsEntry?.() ?? []);
  if (!entries.some((entry) => entry.isDirectory)) return [...transfer.files].map((file) => ({ file }));
  /** @type {Found[]} */
  const out = [];
  for (const entry of entries) await collect(entry, out);
  return out;
}

/**
 * @param {FileSystemEntry} entry
 * @param {Found[]} out
 * @param {FileSystemEntry} [folder]
 */
async function collect(entry, out, folder) {
  if (out.length >= MOST) return;
  if (entry.isFile) {
    const own = /** @type {FileSystemFileEntry} */ (entry);
    /** @type {File} */
    const file = await new Promise((resolve, reject) => own.file(resolve, reject));
    if (!folder || file.type.startsWith('image/')) out.push({ file, folder });
    return;
  }
  const reader = /** @type {FileSystemDirectoryEntry} */ (entry).createReader();
  for (;;) {
    // a reader returns a large folder in parts
    /** @type {FileSystemEntry[]} */
    const batch = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!batch.length) return;
    for (const child of batch) await collect(child, out, entry);
  }
}

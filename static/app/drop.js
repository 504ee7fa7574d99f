// Files of a drop, folders opened.

/** Most files taken from one drop. */
const MOST = 500;

/**
 * All files of a drop; of folders only the pictures. To be called while the event is handled.
 * @param {DataTransfer} transfer
 */
export async function filesOf(transfer) {
  const entries = [...transfer.items].flatMap((item) => item.webkitGetAsEntry?.() ?? []);
  if (!entries.some((entry) => entry.isDirectory)) return [...transfer.files];
  /** @type {File[]} */
  const out = [];
  for (const entry of entries) await collect(entry, out, false);
  return out;
}

/**
 * @param {FileSystemEntry} entry
 * @param {File[]} out
 * @param {boolean} inFolder
 */
async function collect(entry, out, inFolder) {
  if (out.length >= MOST) return;
  if (entry.isFile) {
    const own = /** @type {FileSystemFileEntry} */ (entry);
    /** @type {File} */
    const file = await new Promise((resolve, reject) => own.file(resolve, reject));
    if (!inFolder || file.type.startsWith('image/')) out.push(file);
    return;
  }
  const reader = /** @type {FileSystemDirectoryEntry} */ (entry).createReader();
  for (;;) {
    // a reader gives a part of a large folder at a time
    /** @type {FileSystemEntry[]} */
    const batch = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!batch.length) return;
    for (const child of batch) await collect(child, out, true);
  }
}

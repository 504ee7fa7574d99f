// Files of a drop, folders opened.

/** Most files taken from one drop. */
const MOST = 500;

/** All files of a drop; of folders only the pictures. To be called while the event is handled. */
export async function filesOf(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.some((entry) => entry.isDirectory)) return [...transfer.files];
  const out = [];
  for (const entry of entries) await collect(entry, out, false);
  return out;
}

async function collect(entry, out, inFolder) {
  if (out.length >= MOST) return;
  if (entry.isFile) {
    const file = await new Promise((resolve, reject) => entry.file(resolve, reject));
    if (!inFolder || file.type.startsWith('image/')) out.push(file);
    return;
  }
  const reader = entry.createReader();
  for (;;) {
    // a reader gives a part of a large folder at a time
    const batch = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (!batch.length) return;
    for (const child of batch) await collect(child, out, true);
  }
}

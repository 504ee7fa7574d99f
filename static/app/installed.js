// What the page can do as an installed app: take photos that other apps share, and tell of photos that are done while it is hidden.

/** The registration of its worker; undefined in browsers without one, and on insecure pages. */
const registration = navigator.serviceWorker
  ?.register(new URL('share-worker.js', import.meta.url), { scope: new URL('share/', import.meta.url).pathname })
  .catch(() => undefined);

/** Files that were shared (share-worker.js), each once. */
export async function takeShared() {
  if (!(await globalThis.caches?.has('shared'))) return [];
  const cache = await caches.open('shared');
  const files = (await cache.keys()).map(async (request) => {
    const blob = await (await cache.match(request))?.blob();
    const name = new URL(request.url).searchParams.get('name') ?? '';
    return blob && new File([blob], name, { type: blob.type });
  });
  const taken = (await Promise.all(files)).filter((file) => file !== undefined);
  await caches.delete('shared');
  return taken;
}

/** True if the browser can notify and the user has not decided yet. */
export function mayAsk() {
  return Boolean(registration) && globalThis.Notification?.permission === 'default';
}

/**
 * Notifies the user if the page is hidden and may do so; the newest notification replaces the earlier one.
 * @param {string} text
 * @param {string} address of the page that it opens
 */
export async function notify(text, address) {
  if (!document.hidden || globalThis.Notification?.permission !== 'granted') return;
  const icon = new URL('icon-192.png', import.meta.url).href;
  await (await registration)?.showNotification(text, { icon, data: address, tag: 'tmpi' });
}

// Service worker of the installed page. It sees only what other apps share (`share/`, see manifest.json), no other request.

/**
 * Keeps shared files for the page, which takes and uploads them (installed.js).
 * @param {Request} request
 */
async function keep(request) {
  const files = (await request.formData()).getAll('photo').filter((entry) => entry instanceof File);
  const cache = await caches.open('shared');
  for (const file of files) {
    const address = new URL(`share/${crypto.randomUUID()}?name=${encodeURIComponent(file.name)}`, location.href);
    await cache.put(address, new Response(file));
  }
  return Response.redirect(new URL('../../', location.href), 303);
}

// the types of service workers exclude those of pages
const worker = /** @type {any} */ (self);
worker.addEventListener('fetch', (/** @type {any} */ event) => {
  if (event.request.method === 'POST') event.respondWith(keep(event.request));
});
worker.addEventListener('notificationclick', (/** @type {any} */ event) => {
  event.notification.close();
  event.waitUntil(worker.clients.openWindow(event.notification.data));
});

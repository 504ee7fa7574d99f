// HTML snippets that embed a photo in another page.

/**
 * Text escaped for HTML, including attribute values.
 * @param {string} text
 */
export function escaped(text) {
  const names = /** @type {Record<string, string>} */ ({ '&': 'amp', '<': 'lt', '>': 'gt', '"': 'quot', "'": '#39' });
  return text.replace(/[&<>"']/g, (c) => `&${names[c]};`);
}

/**
 * The HTML snippets that embed a photo.
 * @param {{origin: string, id: string, name: string, width: number, height: number}} photo
 */
export function snippets({ origin, id, name, width, height }) {
  const shape = `width: 100%; aspect-ratio: ${width} / ${height}`;
  const title = escaped(name);
  const at = (/** @type {string} */ part) => escaped(origin + part);
  return {
    frame: `<iframe src="${at(`/embed/${encodeURIComponent(id)}`)}" title="${title}" style="${shape}; border: 0"
  allow="fullscreen; accelerometer; gyroscope; xr-spatial-tracking" loading="lazy"></iframe>`,
    element: `<script type="module" src="${at('/tmpi-viewer.js')}"></script>
<tmpi-viewer src="${at(`/v1/photos/${encodeURIComponent(id)}/atlas`)}" alt="${title}"
  poster="${at(`/v1/photos/${encodeURIComponent(id)}/thumbnail`)}" style="${shape}"></tmpi-viewer>`,
  };
}

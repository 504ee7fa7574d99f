// Helpers for page elements and addresses.

/** Path of the server on its host, '' without one: this module is at `/static/app/` below it. */
const BASE = new URL('../..', import.meta.url).pathname.slice(0, -1);

/**
 * The address of a path that begins with `/`.
 * @param {string} path
 */
export const at = (path) => BASE + path;

/**
 * The page's element with an id; `kind` if a more specific class is needed. Throws if it is missing.
 * @template {HTMLElement} [T=HTMLElement]
 * @param {string} id
 * @param {{new (): T}} [kind]
 * @returns {T}
 */
export function $(id, kind) {
  const found = document.getElementById(id);
  if (!(found instanceof (kind ?? HTMLElement))) throw new Error(`the page has no ${id}`);
  return /** @type {T} */ (found);
}

/**
 * An element with a class and text or children.
 * @template {keyof HTMLElementTagNameMap} K
 * @param {K} tag
 * @param {string} [className]
 * @param {(Node | string)[]} content
 * @returns {HTMLElementTagNameMap[K]}
 */
export function element(tag, className, ...content) {
  const out = document.createElement(tag);
  if (className) out.className = className;
  out.append(...content);
  return out;
}

/**
 * An icon of icons.svg.
 * @param {string} name
 */
export function icon(name) {
  const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  const use = document.createElementNS('http://www.w3.org/2000/svg', 'use');
  use.setAttribute('href', at(`/static/app/icons.svg#${name}`));
  svg.setAttribute('aria-hidden', 'true');
  svg.append(use);
  return svg;
}

/** True if the page's address works on this machine only. */
export const isLoopback = () => /^(localhost|.*\.localhost|127\..*|\[::1\])$/.test(location.hostname);

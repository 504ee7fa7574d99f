// Parts of pages.

/** An element with a class and text or children. */
export function element(tag, className, ...content) {
  const out = document.createElement(tag);
  if (className) out.className = className;
  out.append(...content);
  return out;
}

/** An icon of icons.svg. */
export function icon(name) {
  const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  const use = document.createElementNS('http://www.w3.org/2000/svg', 'use');
  use.setAttribute('href', `/static/app/icons.svg#${name}`);
  svg.setAttribute('aria-hidden', 'true');
  svg.append(use);
  return svg;
}

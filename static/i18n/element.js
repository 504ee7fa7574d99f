// Words of the element itself, which a photo on somebody else's page needs; all others are in messages.js.

/** @type {Record<string, string>} */
export const ELEMENT = { '3D photo': '3D-Foto', '3D video': '3D-Video', 'Full screen': 'Vollbild' };

/** Whether the browser asks for German. */
export const german = Boolean(globalThis.navigator?.language?.toLowerCase().startsWith('de'));

/**
 * A text of the element in the browser's language.
 * @param {string} text
 */
export const word = (text) => (german ? (ELEMENT[text] ?? text) : text);

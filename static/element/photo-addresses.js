// Addresses beside a container's on a server.
import { settingsOf } from '../view/settings.js';
import { linkOf, withLink } from './signed-link.js';

/**
 * An address beside a container's: `…/ID/atlas?level=1&v=V` → `…/ID/view?v=V`; undefined if it is not a server's address. It keeps the
 * container's version, except for the settings, and its link.
 * @param {string} atlas
 * @param {string} part
 */
export function beside(atlas, part) {
  const [path, query] = atlas.split('#')[0].split('?');
  if (!path.endsWith('/atlas')) return undefined;
  const version = part === '/settings' ? null : new URLSearchParams(query).get('v');
  const address = `${path.slice(0, -'/atlas'.length)}${part}${version ? `?v=${encodeURIComponent(version)}` : ''}`;
  return withLink(address, linkOf(query));
}

/**
 * The settings of the photo at an address; empty if there are none.
 * @param {string} address
 */
export async function fetchSettings(address) {
  try {
    const response = await fetch(address);
    if (!response.ok) return {};
    return settingsOf({ settings: await response.json() });
  } catch {
    return {};
  }
}

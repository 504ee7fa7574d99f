// What lies beside a container on a server.
import { settingsOf } from '../view/settings.js';
import { linkOf, withLink } from './link.js';

/**
 * Addresses that lie beside a container's: `…/ID/atlas?level=1&v=V` → `…/ID/view?v=V`, or undefined where it is no photo of a server.
 * What never changes is of the container's version, and all is seen by the link by which that is.
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
 * Settings of the photo at an address, or none where there is no server that keeps any.
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

// What lies beside a container on a server.
import { settingsOf } from '../view/settings.js';

/** Addresses that lie beside a container's: `…/ID/atlas?level=1` → `…/ID/view`, or undefined where it is no photo of a server. */
export function beside(atlas, part) {
  const [path] = atlas.split(/[?#]/);
  return path.endsWith('/atlas') ? path.slice(0, -'/atlas'.length) + part : undefined;
}

/** Settings of the photo at an address, or none where there is no server that keeps any. */
export async function fetchSettings(address) {
  try {
    const response = await fetch(address);
    if (!response.ok) return {};
    return settingsOf(await response.json());
  } catch {
    return {};
  }
}

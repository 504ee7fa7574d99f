// What the owner of a photo wants of viewers, as the server keeps it: how far the camera goes, what stays in place, where it starts.

const NONE = Object.freeze({});

/**
 * Addresses that lie beside a container's: `…/ID/atlas?level=1&v=V` → `…/ID/view?v=V`, or undefined where it is no photo of a server.
 * What never changes is of the container's version.
 */
export function beside(atlas, part) {
  const [path, query] = atlas.split('#')[0].split('?');
  if (!path.endsWith('/atlas')) return undefined;
  const version = part === '/settings' ? null : new URLSearchParams(query).get('v');
  return `${path.slice(0, -'/atlas'.length)}${part}${version ? `?v=${encodeURIComponent(version)}` : ''}`;
}

/** Settings of the photo at an address, or none where there is no server that keeps any. */
export async function fetchSettings(address) {
  try {
    const response = await fetch(address);
    if (!response.ok) return NONE;
    return settingsOf({ settings: await response.json() });
  } catch {
    return NONE;
  }
}

/** Settings of a photo's state; of a version that is not known, none. */
export function settingsOf(state) {
  return state?.settings?.version === 1 ? state.settings : NONE;
}

/** The camera's limits, less where the settings say so. */
export function limited({ x, y, z }, { motion }) {
  return motion ? { x: x * motion.x, y: y * motion.y, z: z * motion.z } : { x, y, z };
}

/** A place in the view box as an offset within the limits that `motion` leaves of it. */
export function offsetOf(place, { motion }) {
  const within = (v, most) => (most > 0 ? Math.max(-1, Math.min(1, v / most)) : 0);
  return motion ? { x: within(place.x, motion.x), y: within(place.y, motion.y), z: within(place.z, motion.z) } : { ...place };
}

/** The reverse: where in the view box an offset is. */
export function placeOf(offset, { motion }) {
  return motion ? { x: offset.x * motion.x, y: offset.y * motion.y, z: offset.z * motion.z } : { ...offset };
}

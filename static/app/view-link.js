// Links to a view: the camera's offset is behind the # of the page's address.

import { t } from '../i18n/messages.js';
import { formatPose, parsePose } from '../view/camera.js';
import { $, isLoopback } from './dom.js';

/** @import { Offset } from '../decode/scene.js' */

const HASH_KEY = 'pose';

/** The start offset in the page's address, in units of the view box. */
export function offsetOfHash() {
  const pose = parsePose(new URLSearchParams(location.hash.slice(1)).get(HASH_KEY) ?? '');
  return pose ? { x: pose.tx, y: pose.ty, z: pose.tz } : undefined;
}

/** True if sharing a link suits the device better than copying it. */
export const canSend = () => Boolean(navigator.share) && matchMedia('(pointer: coarse)').matches;

/**
 * Address of this page at a view.
 * @param {Offset} offset of the camera, in units of the view box
 * @param {{signed?: boolean}} [options] whether it keeps the link with which the page was opened
 */
export function addressAt({ x, y, z }, { signed = true } = {}) {
  const url = new URL(location.href);
  if (!signed) url.search = '';
  const pose = formatPose({ tx: x, ty: y, tz: z });
  url.hash = pose === '0,0,0' ? '' : `${HASH_KEY}=${pose}`;
  return url.href;
}

/**
 * Shares or copies a link to the view at an offset.
 * @param {Offset} offset
 * @param {(text: string) => void} say
 */
export async function shareLink(offset, say) {
  const url = addressAt(offset);
  if (canSend()) {
    try {
      await navigator.share({ title: document.title, url });
      return;
    } catch (error) {
      if (error.name === 'AbortError') return;
    }
  }
  try {
    await navigator.clipboard.writeText(url);
    say(isLoopback() ? t('Link to this view copied. It works only on this machine.') : t('Link to this view copied'));
  } catch {
    // no clipboard on a page without TLS
    const link = $('link', HTMLInputElement);
    link.value = url;
    $('link-dialog', HTMLDialogElement).showModal();
    link.select();
  }
}

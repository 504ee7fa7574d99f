// Touching up the depth of a photo: the user paints over errors of the network and sets how near the surface is. Loaded on demand.

import { t } from '../i18n/messages.js';
import { changeStrokes, getPhoto, photoUrl, strokesOf } from './api.js';
import { $, element } from './dom.js';
import { untilMade } from './follow-photo.js';
import { Outlines, SIDE, touchedUp } from './stroke-region.js';
import { touchUpDialog } from './touch-up-dialog.js';
import { TouchUpView } from './touch-up-view.js';

/** @import { Photo } from './api.js' */
/** @import { Region, Stroke } from './stroke-region.js' */

/** Points of a stroke closer together than this share of the radius are dropped. */
const SPACING = 1 / 8;
/** Maximum number of strokes of a photo, the server's limit. */
const STROKES = 100;
/** A step of the keyboard's brush, as a share of the picture's longer side. */
const STEP = 0.02;
const FINE_STEP = 0.004;
/** @type {Record<string, [number, number]>} */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** @typedef {{stroke: Stroke, region: Region}[]} Edit all strokes */

/** Rounds coordinates to four decimals: finer than a pixel of any screen. */
const place = (/** @type {number} */ v) => Math.round(Math.min(Math.max(v, 0), 1) * 1e4) / 1e4;

/**
 * Opens the editor.
 * @param {{id: string, photo: HTMLImageElement, saved: () => void, say: (text: string) => void}} page the photo's id and picture, what to
 *   do once the photo was made again, and how to show a message
 */
export async function openTouchUp({ id, photo, saved, say }) {
  if (!photo.naturalWidth) throw new Error(t('The photo is not there yet.'));
  const [state, before] = await Promise.all([getPhoto(id), strokesOf(id)]);
  const scale = Math.min(1, SIDE / Math.max(photo.naturalWidth, photo.naturalHeight));
  const width = Math.max(1, Math.round(photo.naturalWidth * scale));
  const height = Math.max(1, Math.round(photo.naturalHeight * scale));
  const rgba = pixels(photo, width, height);
  const map = await depthOf(state, before.strokes.length > 0, width, height);
  const outlines = new Outlines(width, height, rgba, map);
  /** The server's state. @type {Edit} */
  const begun = before.strokes.map((stroke) => ({ stroke, region: outlines.region(stroke) }));
  const dialog = await touchUpDialog();
  const view = new TouchUpView($('touch-photo', HTMLCanvasElement), $('touch-depth', HTMLCanvasElement), photo, width, height);
  const size = $('touch-size', HTMLInputElement);
  const amount = $('touch-amount', HTMLInputElement);

  /** Saved strokes can be undone one by one, too. @type {Edit[]} */
  const past = begun.map((_, n) => begun.slice(0, n));
  /** @type {Edit[]} */
  let future = [];
  let now = begun;
  /** The stroke under the brush. @type {{points: [number, number][], region: Region | null} | null} */
  let brush = null;
  /** A stroke that waits for its reference point. @type {{points: [number, number][], radius: number, region: Region} | null} */
  let waiting = null;
  /** @type {[number, number]} */
  let cursor = [0.5, 0.5];
  let busy = false;
  let frame = 0;

  const wish = () => /** @type {string} */ (new FormData($('touch-form', HTMLFormElement)).get('touch-wish'));
  const radius = () => Number(size.value);
  const changed = () => now !== begun;
  const button = (/** @type {string} */ name) => $(name, HTMLButtonElement);

  function tell(text = '') {
    $('touch-status').textContent = text;
  }

  function hint() {
    if (waiting) return tell(t('Now choose a place at the right depth.'));
    tell(
      wish() === 'like'
        ? t('First paint over what is at the wrong depth, then choose a place at the right depth.')
        : now.at(-1)?.stroke.by !== undefined
          ? t('Move the slider until the depth is right, or keep painting.')
          : t('Paint over what is at the wrong depth. The paint stops at edges in the photo.'),
    );
  }

  function show() {
    const last = now.at(-1);
    amount.disabled = busy || wish() !== 'by';
    if (last?.stroke.by !== undefined) amount.value = String(last.stroke.by);
    button('touch-undo').disabled = busy || !(past.length || waiting || brush);
    button('touch-redo').disabled = busy || !future.length;
    button('touch-clear').disabled = busy || !now.length;
    button('touch-save').disabled = busy || !changed() || Boolean(waiting);
    button('touch-cancel').disabled = busy;
    cancelAnimationFrame(frame);
    frame = requestAnimationFrame(draw);
  }

  function draw() {
    if (brush) brush.region = outlines.region({ points: brush.points, radius: radius() });
    const current = brush?.region ?? waiting?.region ?? now.at(-1)?.region ?? null;
    const keys = document.activeElement === view.canvas && view.canvas.matches(':focus-visible');
    view.draw(current, keys ? { at: cursor, radius: radius() } : null);
    const preview = brush?.region && wish() !== 'like' ? [{ stroke: asked(brush.points), region: brush.region }] : [];
    view.drawDepth(touchedUp(outlines, map, [...now, ...preview]));
  }

  /** @param {Edit} edit */
  function change(edit) {
    past.push(now);
    future = [];
    now = edit;
    hint();
    show();
  }

  /**
   * The stroke through these points with the chosen settings.
   * @param {[number, number][]} points
   * @returns {Stroke}
   */
  function asked(points) {
    const stroke = { points, radius: radius() };
    return wish() === 'far' ? { ...stroke, to: 0 } : { ...stroke, by: Number(amount.value) };
  }

  /** @param {[number, number]} at */
  function press(at) {
    if (busy) return;
    if (waiting) {
      const { points, radius: painted, region } = waiting;
      waiting = null;
      return change([...now, { stroke: { points, radius: painted, like: at }, region }]);
    }
    if (now.length >= STROKES) return tell(t('A photo has at most {0} strokes.', STROKES));
    brush = { points: [at], region: null };
    show();
  }

  /** @param {[number, number]} at */
  function move(at) {
    const last = brush?.points.at(-1);
    if (!brush || !last) return;
    const longer = Math.max(width, height);
    const far = Math.hypot(((at[0] - last[0]) * width) / longer, ((at[1] - last[1]) * height) / longer);
    if (far < radius() * SPACING) return;
    brush.points.push(at);
    show();
  }

  function release() {
    if (!brush) return;
    const { points } = brush;
    const region = outlines.region({ points, radius: radius() });
    brush = null;
    if (wish() === 'like') {
      waiting = { points, radius: radius(), region };
      hint();
      return show();
    }
    change([...now, { stroke: asked(points), region }]);
  }

  function undo() {
    if (busy) return;
    if (brush || waiting) {
      brush = waiting = null;
    } else {
      const earlier = past.pop();
      if (!earlier) return;
      future.push(now);
      now = earlier;
    }
    hint();
    show();
  }

  function redo() {
    const later = busy ? undefined : future.pop();
    if (!later) return;
    past.push(now);
    now = later;
    hint();
    show();
  }

  async function save() {
    busy = true;
    tell(t('Making the photo again…'));
    show();
    try {
      const strokes = now.map(({ stroke }) => stroke);
      const answer = await changeStrokes(id, strokes, before.etag);
      if (answer.state !== 'done') await untilMade(id);
      dialog.close();
      saved();
      say(t('Saved'));
    } catch (error) {
      tell(error.message);
    } finally {
      busy = false;
      show();
    }
  }

  const { signal, abort } = abortable();
  const on = (/** @type {EventTarget} */ target, /** @type {string} */ name, /** @type {(event: any) => void} */ run) =>
    target.addEventListener(name, run, { signal });
  const at = (/** @type {PointerEvent} */ { clientX, clientY }) => {
    const box = view.canvas.getBoundingClientRect();
    return /** @type {[number, number]} */ ([place((clientX - box.x) / box.width), place((clientY - box.y) / box.height)]);
  };
  on(view.canvas, 'pointerdown', (event) => {
    if (event.button !== 0 || !event.isPrimary) return;
    view.canvas.setPointerCapture(event.pointerId);
    cursor = at(event);
    press(cursor);
  });
  on(view.canvas, 'pointermove', (event) => {
    if (!event.isPrimary) return;
    for (const part of event.getCoalescedEvents?.() ?? [event]) move(at(part));
  });
  on(view.canvas, 'pointerup', (event) => event.isPrimary && release());
  on(view.canvas, 'pointercancel', () => brush && undo());
  on(view.canvas, 'keydown', (event) => {
    const direction = ARROWS[event.key];
    if (direction) {
      const step = (event.shiftKey ? FINE_STEP : STEP) * Math.max(width, height);
      cursor = [place(cursor[0] + (direction[0] * step) / width), place(cursor[1] + (direction[1] * step) / height)];
      move(cursor);
    } else if (event.key === ' ' || event.key === 'Enter') {
      // the first press puts the brush down, the next lifts it
      if (brush) release();
      else press(cursor);
    } else return;
    event.preventDefault();
    show();
  });
  on(view.canvas, 'focus', show);
  on(view.canvas, 'blur', show);
  // not on the dialog: a focused button that becomes disabled receives no keys
  on(window, 'keydown', (event) => {
    if (!(event.ctrlKey || event.metaKey) || event.key.toLowerCase() !== 'z') return;
    event.preventDefault();
    if (event.shiftKey) redo();
    else undo();
  });
  on(amount, 'input', () => {
    // the last stroke follows the slider; one undo removes the stroke, not the slider's change
    const last = now.at(-1);
    if (last?.stroke.by !== undefined) now = [...now.slice(0, -1), { ...last, stroke: { ...last.stroke, by: Number(amount.value) } }];
    show();
  });
  on($('touch-form'), 'change', () => {
    hint();
    show();
  });
  on(size, 'input', show);
  on(button('touch-undo'), 'click', undo);
  on(button('touch-redo'), 'click', redo);
  on(button('touch-clear'), 'click', () => change([]));
  on(button('touch-save'), 'click', save);
  on(button('touch-cancel'), 'click', () => dialog.close());
  on(dialog, 'cancel', (event) => busy && event.preventDefault());
  on(window, 'resize', show);
  on(dialog, 'close', () => {
    abort();
    cancelAnimationFrame(frame);
    dialog.remove();
  });
  dialog.showModal();
  hint();
  show();
}

function abortable() {
  const controller = new AbortController();
  return { signal: controller.signal, abort: () => controller.abort() };
}

/**
 * Pixels of a picture at a size.
 * @param {CanvasImageSource} picture
 * @param {number} width
 * @param {number} height
 */
function pixels(picture, width, height) {
  const canvas = element('canvas');
  [canvas.width, canvas.height] = [width, height];
  const context = canvas.getContext('2d', { willReadFrequently: true });
  if (!context) throw new Error(t('This browser does not allow it'));
  context.imageSmoothingQuality = 'high';
  context.drawImage(picture, 0, 0, width, height);
  return context.getImageData(0, 0, width, height).data;
}

/**
 * The disparity of a photo at a size, 0 to 1, below the strokes.
 * @param {Photo} state
 * @param {boolean} strokes whether it has any
 * @param {number} width
 * @param {number} height
 */
async function depthOf({ id, version }, strokes, width, height) {
  const query = new URLSearchParams();
  if (strokes) query.set('before', 'strokes');
  if (version) query.set('v', version);
  const response = await fetch(photoUrl(id, `/depth?${query}`));
  if (!response.ok) throw new Error(t('The depth cannot be loaded.'));
  const bitmap = await createImageBitmap(await response.blob(), { colorSpaceConversion: 'none' });
  const rgba = pixels(bitmap, width, height);
  return new Float32Array(width * height).map((_, i) => rgba[4 * i] / 255);
}

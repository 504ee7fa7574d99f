// Handles pointer, touch, wheel and keyboard input.

/** @import { Motion } from './camera-motion.js' */
/** @import { Zoom } from './zoom.js' */

/** Camera move per key press, in units of the limits, and zoom factor per key press. */
const KEY_STEP = 0.2;
const KEY_ZOOM = 1.25;
/** Wheel pixels per zoom factor of e. Browsers report a touchpad pinch as a small wheel movement with Ctrl. */
const WHEEL_PX = 400;
const PINCH_PX = 100;
/** Limits of a tap's duration and movement. Two taps within TAP_MS are a double tap; a change of TAP_PX between two fingers is a pinch. */
const TAP_MS = 300;
const TAP_PX = 12;
const DOUBLE_PX = 40;
/** Decay length of the offset that a drag leaves behind, in hover movement as a share of the width. */
const OFFSET_DECAY = 0.25;

/**
 * Listens on `element` and drives `motion` and `zoom`. It calls `wake` after every input and `toggleIdle` on the space bar.
 *
 * `embedded` returns whether the element is part of a page that scrolls. If so, the wheel zooms only if the element has the focus or Ctrl
 * is pressed; zooming out beyond the whole photo, and dragging up or down with one finger (`touch-action: pan-y`), scroll the page.
 * Two-finger gestures always work.
 * @param {HTMLElement} element
 * @param {Motion} motion
 * @param {Zoom} zoom
 * @param {{wake: () => void, toggleIdle: () => void, embedded?: () => boolean}} on
 * @returns {() => void} stops listening
 */
export function listen(element, motion, zoom, { wake, toggleIdle, embedded = () => false }) {
  const stop = new AbortController();
  /**
   * @template {keyof HTMLElementEventMap} K
   * @param {K} type
   * @param {(event: HTMLElementEventMap[K]) => void} handler
   * @param {AddEventListenerOptions} [options]
   */
  const on = (type, handler, options) => element.addEventListener(type, handler, { signal: stop.signal, ...options });
  /** @type {Map<number, {x: number, y: number}>} */
  const pointers = new Map();
  // offset between the camera and the pointer's target after a drag
  const offset = { x: 0, y: 0 };
  /** @type {{x: number, y: number} | null} */
  let hovered = null;
  let dragged = false;
  /** @type {{x: number, y: number, time: number, moved: boolean, ours: boolean} | null} */
  let press = null;
  // distance between two fingers when the second touched
  let startDistance = 0;
  let pinching = false;
  let lastTap = { x: 0, y: 0, time: -Infinity };

  /** @param {{clientX: number, clientY: number}} event */
  const fromCentre = ({ clientX, clientY }) => {
    const box = element.getBoundingClientRect();
    return { x: clientX - box.left - box.width / 2, y: clientY - box.top - box.height / 2 };
  };

  on('pointerdown', (event) => {
    if (event.button !== 0) return;
    element.setPointerCapture(event.pointerId);
    const { clientX: x, clientY: y, timeStamp: time } = event;
    press = pointers.size === 0 ? { x, y, time, moved: false, ours: event.pointerType !== 'touch' || !embedded() } : null;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    [startDistance, pinching] = [fingerDistance(), false];
  });
  on('pointermove', (event) => {
    const last = pointers.get(event.pointerId);
    if (last) drag(event, last);
    else if (event.pointerType === 'mouse' && !motion.steered) hover(event);
  });
  const release = (/** @type {PointerEvent} */ event) => {
    pointers.delete(event.pointerId);
    if (event.type === 'pointerup' && press && !press.moved && event.timeStamp - press.time < TAP_MS) tap(event);
    press = null;
  };
  on('pointerup', release);
  on('pointercancel', release);
  on('pointerleave', (event) => {
    hovered = null;
    // keep the camera where a drag has put it
    if (event.pointerType !== 'mouse' || motion.steered || pointers.size > 0 || dragged) return;
    motion.aim(0, 0);
    wake();
  });

  /** @param {PointerEvent} event */
  function hover(event) {
    const box = element.getBoundingClientRect();
    // as in a drag, near things follow the pointer
    const aim = { x: 1 - ((event.clientX - box.left) / box.width) * 2, y: 1 - ((event.clientY - box.top) / box.height) * 2 };
    if (dragged) {
      [offset.x, offset.y] = [motion.raw.x - aim.x, motion.raw.y - aim.y];
      dragged = false;
    }
    const moved = hovered ? Math.hypot(aim.x - hovered.x, aim.y - hovered.y) / 2 : 0;
    const decay = Math.exp(-moved / OFFSET_DECAY);
    [offset.x, offset.y] = [offset.x * decay, offset.y * decay];
    hovered = aim;
    motion.aim(aim.x + offset.x, aim.y + offset.y);
    wake();
  }

  /**
   * @param {PointerEvent} event
   * @param {{x: number, y: number}} last
   */
  function drag(event, last) {
    const [across, down] = press ? [event.clientX - press.x, event.clientY - press.y] : [0, 0];
    if (press && Math.hypot(across, down) > TAP_PX) press.moved = true;
    // a vertical drag scrolls the page, which the browser does
    if (press && Math.abs(across) > Math.abs(down)) press.ours = true;
    const before = fingerDistance();
    const share = pointers.size;
    const [dx, dy] = [(event.clientX - last.x) / share, (event.clientY - last.y) / share];
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (press && !press.ours) return;
    // two fingers that move in parallel send separate events, so their distance varies a little
    if (Math.abs(fingerDistance() - startDistance) > TAP_PX) pinching = true;
    if (before && pinching) {
      const [a, b] = [...pointers.values()];
      zoom.by(fingerDistance() / before, fromCentre({ clientX: (a.x + b.x) / 2, clientY: (a.y + b.y) / 2 }));
      zoom.settle();
    }
    if (zoom.close) {
      zoom.pan(dx, dy);
      motion.touched();
    } else {
      // near things follow the pointer, so the camera moves the opposite way
      const { width } = element.getBoundingClientRect();
      motion.nudge((-4 * dx) / width, (-4 * dy) / width, 0);
      dragged = true;
    }
    wake();
  }

  /** @param {PointerEvent} event */
  function tap(event) {
    const near = Math.hypot(event.clientX - lastTap.x, event.clientY - lastTap.y) < DOUBLE_PX;
    if (near && event.timeStamp - lastTap.time < TAP_MS) {
      zoom.toggle(fromCentre(event));
      wake();
    }
    lastTap = { x: event.clientX, y: event.clientY, time: event.timeStamp };
  }

  /** Distance between two fingers, or 0 without two. */
  function fingerDistance() {
    if (pointers.size !== 2) return 0;
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  }

  on(
    'wheel',
    (event) => {
      if (embedded() && ((!event.ctrlKey && !element.matches(':focus')) || (event.deltaY > 0 && !zoom.close))) return;
      event.preventDefault();
      const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 16 : 1;
      zoom.by(Math.exp((-event.deltaY * lines) / (event.ctrlKey ? PINCH_PX : WHEEL_PX)), fromCentre(event));
      wake();
    },
    { passive: false },
  );

  const centre = { x: 0, y: 0 };
  const home = () => {
    motion.home();
    zoom.home();
  };
  /** @type {Record<string, () => void>} */
  const keys = {
    ArrowLeft: () => motion.nudge(-KEY_STEP, 0, 0),
    ArrowRight: () => motion.nudge(KEY_STEP, 0, 0),
    ArrowUp: () => motion.nudge(0, -KEY_STEP, 0),
    ArrowDown: () => motion.nudge(0, KEY_STEP, 0),
    '+': () => zoom.by(KEY_ZOOM, centre),
    '=': () => zoom.by(KEY_ZOOM, centre),
    '-': () => zoom.by(1 / KEY_ZOOM, centre),
    0: home,
    Home: home,
    ' ': toggleIdle,
  };
  on('keydown', (event) => {
    const action = keys[event.key];
    if (!action || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    action();
    wake();
  });
  return () => stop.abort();
}

// Pointer, touch, wheel and keys: what they move.

/** @import { Motion } from './motion.js' */
/** @import { Zoom } from './zoom.js' */

/** Way of a key, in units of the limits; how much closer a key comes. */
const KEY_STEP = 0.2;
const KEY_ZOOM = 1.25;
/** Pixels of the wheel that come closer by a factor of e; a pinch on a touchpad is told as a small turn of the wheel. */
const WHEEL_PX = 400;
const PINCH_PX = 100;
/** A tap lasts and strays no longer than this, and two within that time are one gesture; so far two fingers' distance may change without a pinch. */
const TAP_MS = 300;
const TAP_PX = 12;
const DOUBLE_PX = 40;
/** Way of a hovering pointer after which what a drag left is forgotten, as a share of the width. */
const FORGOTTEN = 0.25;

/**
 * Listens on `element` and drives `motion` and `zoom`. `wake` is called after every input; `toggleIdle` on the space bar. `embedded`: whether
 * a page around it scrolls by wheel and finger now, so that the wheel zooms where the element has the focus or Ctrl is held, what cannot zoom
 * out any more scrolls, and so does one finger that goes up or down (`touch-action: pan-y`); two fingers do all.
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
  // what a drag left between where the camera is and where the pointer would have it
  const left = { x: 0, y: 0 };
  /** @type {{x: number, y: number} | null} */
  let hovered = null;
  let dragged = false;
  /** @type {{x: number, y: number, time: number, moved: boolean, ours: boolean} | null} */
  let press = null;
  // distance of two fingers when the second came
  let apart = 0;
  let pinching = false;
  let lastTap = { x: 0, y: 0, time: -Infinity };

  /** @param {{clientX: number, clientY: number}} event */
  const fromMiddle = ({ clientX, clientY }) => {
    const box = element.getBoundingClientRect();
    return { x: clientX - box.left - box.width / 2, y: clientY - box.top - box.height / 2 };
  };

  on('pointerdown', (event) => {
    if (event.button !== 0) return;
    element.setPointerCapture(event.pointerId);
    const { clientX: x, clientY: y, timeStamp: time } = event;
    press = pointers.size === 0 ? { x, y, time, moved: false, ours: event.pointerType !== 'touch' || !embedded() } : null;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    [apart, pinching] = [spread(), false];
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
    // where a drag put it, it stays
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
      [left.x, left.y] = [motion.raw.x - aim.x, motion.raw.y - aim.y];
      dragged = false;
    }
    const way = hovered ? Math.hypot(aim.x - hovered.x, aim.y - hovered.y) / 2 : 0;
    const stays = Math.exp(-way / FORGOTTEN);
    [left.x, left.y] = [left.x * stays, left.y * stays];
    hovered = aim;
    motion.aim(aim.x + left.x, aim.y + left.y);
    wake();
  }

  /**
   * @param {PointerEvent} event
   * @param {{x: number, y: number}} last
   */
  function drag(event, last) {
    const [across, down] = press ? [event.clientX - press.x, event.clientY - press.y] : [0, 0];
    if (press && Math.hypot(across, down) > TAP_PX) press.moved = true;
    // one that goes up or down is about to scroll the page, which the browser does
    if (press && Math.abs(across) > Math.abs(down)) press.ours = true;
    const before = spread();
    const share = pointers.size;
    const [dx, dy] = [(event.clientX - last.x) / share, (event.clientY - last.y) / share];
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (press && !press.ours) return;
    // fingers that go side by side are told of one after the other
    if (Math.abs(spread() - apart) > TAP_PX) pinching = true;
    if (before && pinching) {
      const [a, b] = [...pointers.values()];
      zoom.by(spread() / before, fromMiddle({ clientX: (a.x + b.x) / 2, clientY: (a.y + b.y) / 2 }));
      zoom.settle();
    }
    if (zoom.close) {
      zoom.pan(dx, dy);
      motion.touched();
    } else {
      // near things follow the pointer, so the camera goes the other way
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
      zoom.toggle(fromMiddle(event));
      wake();
    }
    lastTap = { x: event.clientX, y: event.clientY, time: event.timeStamp };
  }

  /** Distance of two touching fingers, or 0. */
  function spread() {
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
      zoom.by(Math.exp((-event.deltaY * lines) / (event.ctrlKey ? PINCH_PX : WHEEL_PX)), fromMiddle(event));
      wake();
    },
    { passive: false },
  );

  const middle = { x: 0, y: 0 };
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
    '+': () => zoom.by(KEY_ZOOM, middle),
    '=': () => zoom.by(KEY_ZOOM, middle),
    '-': () => zoom.by(1 / KEY_ZOOM, middle),
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

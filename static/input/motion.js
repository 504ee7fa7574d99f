// Where the camera should be: takes pointer, touch, wheel and keys, keeps to the view box, and eases there.
// All offsets are in units of the view box's half extents: -1 to 1 on each axis.

const AXES = ['x', 'y', 'z'];
/** Time constant of the critically damped spring, seconds. */
const EASE_S = 0.11;
/** Longest step that the spring takes at once, so that a pause does not make it jump. */
const MAX_STEP_S = 0.05;
const REST = 1e-4;
/** Idle motion: period, extents, and how long after the last input it starts and how long it takes to swell. */
const SWING = { period: 8, x: 0.75, y: 0.3, delay: 1.6, swell: 2.5 };
/** Beyond the limits a drag goes on with less and less effect; this is how sharp the knee is. */
const KNEE = 3;
const MAX_RAW = 2.5;
const KEY_STEP = 0.2;
const WHEEL_STEP = 1 / 600;

/** Smooth clamp of any number to (-1, 1); close to the identity around 0. */
export function softLimit(v) {
  return v / (1 + Math.abs(v) ** KNEE) ** (1 / KNEE);
}

/** The number that `softLimit` takes to `v`; short of the limits, where there is none. */
function hardened(v) {
  const inside = Math.max(-0.98, Math.min(0.98, v || 0));
  return inside / (1 - Math.abs(inside) ** KNEE) ** (1 / KNEE);
}

export class Motion {
  constructor() {
    this.raw = { x: 0, y: 0, z: 0 };
    this.now = { x: 0, y: 0, z: 0 };
    this.speed = { x: 0, y: 0, z: 0 };
    this.idle = false;
    /** True while something else than the pointer aims: a mouse that only hovers must not fight it. */
    this.steered = false;
    this.quiet = SWING.delay;
    this.phase = 0;
    this.level = 0;
  }

  /** Moves the target by an offset. */
  nudge(dx, dy, dz) {
    // not far beyond the knee, or the way back would feel dead
    const bounded = (v) => Math.max(-MAX_RAW, Math.min(MAX_RAW, v));
    this.raw = { x: bounded(this.raw.x + dx), y: bounded(this.raw.y + dy), z: bounded(this.raw.z + dz) };
    this.touched();
  }

  /** Sets the target on x and y. */
  aim(x, y) {
    this.raw.x = x;
    this.raw.y = y;
    this.touched();
  }

  /** Back to where the photo was taken. */
  home() {
    this.raw = { x: 0, y: 0, z: 0 };
    this.touched();
  }

  /** Puts the camera there at once, within the view box. */
  jump({ x, y, z }) {
    this.raw = { x: hardened(x), y: hardened(y), z: hardened(z) };
    this.now = { x: softLimit(this.raw.x), y: softLimit(this.raw.y), z: softLimit(this.raw.z) };
    this.speed = { x: 0, y: 0, z: 0 };
    this.touched();
  }

  /** Input came: idle motion waits. */
  touched() {
    this.quiet = 0;
  }

  setIdle(on) {
    this.idle = on;
    this.quiet = on ? SWING.delay : 0;
  }

  /** Advances by `dt` seconds; true while anything moves or will move by itself. */
  step(dt) {
    this.quiet += dt;
    const swinging = this.idle && this.quiet > SWING.delay;
    this.level = Math.max(0, Math.min(1, this.level + (swinging ? dt : -dt * 4) / SWING.swell));
    if (this.level > 0) this.phase += (dt * 2 * Math.PI) / SWING.period;
    // where the pointer left the camera fades out as the swing fades in
    const rest = 1 - this.level;
    const target = {
      x: softLimit(this.raw.x) * rest + Math.sin(this.phase) * SWING.x * this.level,
      y: softLimit(this.raw.y) * rest + Math.sin(this.phase * 2) * SWING.y * this.level,
      z: softLimit(this.raw.z),
    };
    let moving = this.idle || this.level > 0;
    for (let left = Math.min(dt, 4 * MAX_STEP_S); left > 0; left -= MAX_STEP_S) {
      for (const axis of AXES) moving = this.#spring(axis, target[axis], Math.min(left, MAX_STEP_S)) || moving;
    }
    return moving;
  }

  #spring(axis, target, dt) {
    const omega = 2 / EASE_S;
    const distance = this.now[axis] - target;
    const decay = Math.exp(-omega * dt);
    const pull = (this.speed[axis] + omega * distance) * dt;
    this.now[axis] = target + (distance + pull) * decay;
    this.speed[axis] = (this.speed[axis] - omega * pull) * decay;
    if (Math.abs(this.now[axis] - target) > REST || Math.abs(this.speed[axis]) > REST) return true;
    this.now[axis] = target;
    this.speed[axis] = 0;
    return false;
  }
}

/**
 * Listens on `element` and drives `motion`. `wake` is called after every input; `toggleIdle` on the space bar. `embedded`: the
 * wheel scrolls the page unless the element has the focus.
 * @returns {() => void} stops listening
 */
export function listen(element, motion, { wake, toggleIdle, embedded }) {
  const stop = new AbortController();
  const on = (type, handler, options) => element.addEventListener(type, handler, { signal: stop.signal, ...options });
  const pointers = new Map();
  // after a drag the camera stays where it was put until the pointer comes back
  let hovering = true;

  on('pointerdown', (event) => {
    if (event.button !== 0) return;
    element.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    hovering = false;
  });
  on('pointermove', (event) => {
    const box = element.getBoundingClientRect();
    const last = pointers.get(event.pointerId);
    if (last) drag(event, last, box);
    else if (event.pointerType === 'mouse' && hovering && !motion.steered) {
      // as in a drag, near things follow the pointer
      motion.aim(1 - ((event.clientX - box.left) / box.width) * 2, 1 - ((event.clientY - box.top) / box.height) * 2);
      wake();
    }
  });
  const release = (event) => pointers.delete(event.pointerId);
  on('pointerup', release);
  on('pointercancel', release);
  on('pointerenter', () => (hovering = pointers.size === 0));
  on('pointerleave', (event) => {
    if (event.pointerType === 'mouse' && hovering && !motion.steered) {
      motion.aim(0, 0);
      wake();
    }
  });

  function drag(event, last, box) {
    const before = spread();
    const share = pointers.size;
    // near things follow the pointer, so the camera goes the other way
    const dx = (-4 * (event.clientX - last.x)) / box.width / share;
    const dy = (-4 * (event.clientY - last.y)) / box.width / share;
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    const dz = before ? (spread() - before) / (box.width / 3) : 0;
    motion.nudge(dx, dy, dz);
    wake();
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
      if (embedded && !element.matches(':focus')) return;
      event.preventDefault();
      const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 16 : 1;
      motion.nudge(0, 0, -event.deltaY * lines * WHEEL_STEP);
      wake();
    },
    { passive: false },
  );

  const keys = {
    ArrowLeft: () => motion.nudge(-KEY_STEP, 0, 0),
    ArrowRight: () => motion.nudge(KEY_STEP, 0, 0),
    ArrowUp: () => motion.nudge(0, -KEY_STEP, 0),
    ArrowDown: () => motion.nudge(0, KEY_STEP, 0),
    '+': () => motion.nudge(0, 0, KEY_STEP),
    '=': () => motion.nudge(0, 0, KEY_STEP),
    '-': () => motion.nudge(0, 0, -KEY_STEP),
    0: () => motion.home(),
    Home: () => motion.home(),
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

// The WebGPU device that all viewers of a page share, from the first viewer to the last.

/**
 * Features that are used if available.
 * @type {GPUFeatureName[]}
 */
const OPTIONAL = ['float32-blendable'];

/** @type {{opening: Promise<Device>, device?: Device} | null} */
let shared = null;

/** The graphics adapter, or null if the browser has none. */
export async function findAdapter() {
  try {
    return (await navigator.gpu?.requestAdapter({ powerPreference: 'high-performance' })) ?? null;
  } catch {
    return null;
  }
}

export class Device {
  users = 0;
  /**
   * Shared resources, by name.
   * @type {Map<string, Promise<any>>}
   */
  #made = new Map();
  /** Runs builds one at a time, so that each sees only its own errors. */
  #last = Promise.resolve();

  /** @param {GPUDevice} handle */
  constructor(handle) {
    this.handle = handle;
    handle.lost.then(() => {
      if (shared?.device === this) shared = null;
    });
  }

  /**
   * The result of `make`, which is called once, or again after a failure.
   * @template T
   * @param {string} name
   * @param {() => Promise<T>} make
   * @returns {Promise<T>}
   */
  once(name, make) {
    const made = this.#made.get(name) ?? make();
    this.#made.set(name, made);
    made.catch(() => this.#made.delete(name));
    return made;
  }

  /**
   * Runs `build` after the earlier ones; throws its error or the device's.
   * @param {() => Promise<void>} build
   */
  build(build) {
    const run = async () => {
      this.handle.pushErrorScope('validation');
      this.handle.pushErrorScope('out-of-memory');
      /** @type {Error | null} */
      let failure = null;
      try {
        await build();
      } catch (error) {
        failure = error;
      }
      const memory = await this.handle.popErrorScope();
      const validation = await this.handle.popErrorScope();
      const problem = failure ?? memory ?? validation;
      if (problem) throw new Error(problem.message);
    };
    const done = this.#last.then(run);
    this.#last = done.catch(() => {});
    return done;
  }

  /** Call it once for each `acquireDevice`. */
  release() {
    if (--this.users > 0) return;
    if (shared?.device === this) shared = null;
    this.handle.destroy();
  }
}

/** The page's device; the caller must release it. */
export async function acquireDevice() {
  shared ??= { opening: open() };
  const own = shared;
  try {
    own.device = await own.opening;
  } catch (error) {
    if (shared === own) shared = null;
    throw error;
  }
  own.device.users++;
  return own.device;
}

async function open() {
  const adapter = await findAdapter();
  if (!adapter) throw new Error('there is no graphics adapter');
  const { maxTextureDimension2D } = adapter.limits;
  const requiredFeatures = OPTIONAL.filter((name) => adapter.features.has(name));
  return new Device(await adapter.requestDevice({ requiredFeatures, requiredLimits: { maxTextureDimension2D } }));
}

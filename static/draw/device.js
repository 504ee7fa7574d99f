// One WebGPU device for all viewers of a page: it opens with the first and goes with the last.

/** @type {{opening: Promise<Device>, device?: Device} | null} */
let shared = null;

/** The graphics adapter, or null where the browser has none. */
export async function findAdapter() {
  try {
    return (await navigator.gpu?.requestAdapter({ powerPreference: 'high-performance' })) ?? null;
  } catch {
    return null;
  }
}

class Device {
  users = 0;
  /** Pipelines by canvas format, as promises. */
  pipelines = new Map();
  /** Builds come one after the other, so that each sees its own errors. */
  #last = Promise.resolve();

  constructor(handle) {
    this.handle = handle;
    handle.lost.then(() => {
      if (shared?.device === this) shared = null;
    });
  }

  /** Runs `build` after those before it; throws what it or the device reports. */
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
      if (failure ?? memory ?? validation) throw new Error((failure ?? memory ?? validation).message);
    };
    const done = this.#last.then(run);
    this.#last = done.catch(() => {});
    return done;
  }

  /** To be called once by everybody who got it. */
  release() {
    if (--this.users > 0) return;
    if (shared?.device === this) shared = null;
    this.handle.destroy();
  }
}

/** The page's device; whoever gets it has to release it. */
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
  const side = adapter.limits.maxTextureDimension2D;
  return new Device(await adapter.requestDevice({ requiredLimits: { maxTextureDimension2D: side } }));
}

// Finds the longest main-thread tasks while a photo opens, from Chromium's trace. Separates CPU time from wall time, because software rendering
// uses the same processors in another process.
import { launch } from '../support/browser.mjs';

const CATEGORIES = ['toplevel', 'devtools.timeline', 'disabled-by-default-devtools.timeline', 'v8', 'blink.user_timing'];
/** The trace continues this long after the first view, while the scene moves. */
const AFTER_MS = 500;

/** In the page: opens a photo and waits until it is drawn. */
async function openPhoto([address, container]) {
  const { Viewer } = await import(`${address}view/viewer.js`);
  performance.mark('opening');
  const viewer = new Viewer(document.getElementById('stage'), { atlas: container });
  const mode = await new Promise((done, fail) => {
    viewer.addEventListener('ready', ({ detail }) => done(detail.mode), { once: true });
    viewer.addEventListener('error', ({ detail }) => fail(new Error(detail.message)), { once: true });
  });
  await viewer.renderer?.idle();
  return mode;
}

/** Main-thread tasks by descending CPU time, each with its longest events. */
function tasksOf(events) {
  const main = events.find(({ name, args }) => name === 'opening' || args?.data?.name === 'opening');
  const mainEvents = events.filter(({ pid, tid, ph }) => ph === 'X' && pid === main?.pid && tid === main.tid);
  const tasks = mainEvents.filter(({ name }) => name === 'RunTask');
  return tasks
    .map((task) => {
      const within = mainEvents.filter(
        (e) => e !== task && e.ts >= task.ts && e.ts + (e.dur ?? 0) <= task.ts + task.dur && !/RunTask$/.test(e.name),
      );
      within.sort((a, b) => (b.dur ?? 0) - (a.dur ?? 0));
      return { ms: task.dur / 1000, cpuMs: task.tdur / 1000, what: within.slice(0, 3).map(describe) };
    })
    .sort((a, b) => b.cpuMs - a.cpuMs);
}

function describe({ name, dur, args }) {
  const data = args?.data ?? {};
  const place = data.functionName || data.url || data.type || '';
  return `${name}${place && ` ${String(place).split('/').slice(-2).join('/')}`} ${((dur ?? 0) / 1000).toFixed(1)}`;
}

/**
 * Main-thread tasks while a container opens.
 * @param {string} address of static/
 * @param {string} container URL
 */
export async function pageTasks(address, container, webgpu) {
  const browser = await launch({ webgpu });
  try {
    const page = await browser.newPage({ viewport: { width: 1280, height: 800 } });
    await page.goto(`${address}stage`);
    await browser.startTracing(page, { categories: CATEGORIES });
    const mode = await page.evaluate(openPhoto, [address, container]);
    await page.waitForTimeout(AFTER_MS);
    const { traceEvents } = JSON.parse((await browser.stopTracing()).toString());
    return { mode, tasks: tasksOf(traceEvents) };
  } finally {
    await browser.close();
  }
}

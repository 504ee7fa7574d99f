// Runs the tests in the given files, or all: `node run.mjs [FILE…]`. Tests without a browser run first; the others share one Chromium, and one
// whose camera plays a film.
import { mkdtempSync, readdirSync, readFileSync, rmSync } from 'node:fs';
import { availableParallelism, tmpdir } from 'node:os';
import { join, relative, resolve } from 'node:path';
import { finished } from 'node:stream/promises';
import { run } from 'node:test';
import { spec as Spec } from 'node:test/reporters';
import { launchShared, launchSharedCamera, SHARED, SHARED_CAMERA } from './support/browser.mjs';

const FOLDER = import.meta.dirname;
/** Number of slowest tests to print. */
const SLOWEST = 10;
/** Time limit for a test file. */
const FILE_MS = 10 * 60_000;
/** Browser test files that run in parallel. On two cores, five files took 121 and 117 s one by one, 99 and 97 s in pairs (`TMPI_PAGES_AT_ONCE=1`, `2`). */
const BROWSER_CONCURRENCY = Number(process.env.TMPI_PAGES_AT_ONCE || Math.min(2, availableParallelism()));
/** Files that measure time or rates, which run alone. The other tests of rooms wait for conditions. */
const TIMED = /^live\/(?:hidden-page|room)\./;
/**
 * The longest files with a browser, which start first, so that none of them runs alone in the end; only one has rooms,
 * because two such files slow each other down.
 */
const LONG =
  /^app\/(?:controls|end-to-end|export|fullscreen|share|touch-up)\.|^draw\/scenes|^element\/(?:frameworks|many|restrictive)|^input\/gestures|^live\/streams|^view\/lifetime/;

/** Whether test files import a module in `support`, directly or not, by their names. */
function importersOf(module) {
  const known = new Map([[join(FOLDER, 'support', module), true]]);
  const imports = (path) => {
    if (!known.has(path)) {
      known.set(path, false);
      const imported = [...readFileSync(path, 'utf8').matchAll(/ from '(\.[^']+\.mjs)'/g)].map(([, name]) => resolve(path, '..', name));
      known.set(path, imported.some(imports));
    }
    return known.get(path);
  };
  return (name) => imports(join(FOLDER, name));
}

const all = readdirSync(FOLDER, { recursive: true }).filter((name) => name.endsWith('.test.mjs') && !name.startsWith('node_modules'));
const named = process.argv.slice(2).map((name) => relative(FOLDER, resolve(name)));
const files = (named.length ? named : all).toSorted();
const browserFiles = files.filter(importersOf('browser.mjs'));
const withoutBrowser = files.filter((name) => !browserFiles.includes(name));
const together = browserFiles.filter((name) => !TIMED.test(name)).toSorted((a, b) => LONG.test(b) - LONG.test(a));
const groups = [
  // on two cores one group, so that no core waits for the other group's last file
  ...(BROWSER_CONCURRENCY === availableParallelism()
    ? [{ files: [...withoutBrowser, ...together], concurrency: BROWSER_CONCURRENCY }]
    : [
        { files: withoutBrowser, concurrency: availableParallelism() },
        { files: together, concurrency: BROWSER_CONCURRENCY },
      ]),
  { files: browserFiles.filter((name) => TIMED.test(name)), concurrency: 1 },
];

const totals = { passed: 0, failed: 0, skipped: 0 };
const tests = [];
const seconds = new Map();

/** Counts a finished test, or adds a suite's time to its file. */
function count(outcome, { name, nesting, details, file, skip }) {
  const took = details.duration_ms / 1000;
  const path = relative(FOLDER, file ?? FOLDER);
  if (nesting === 0) seconds.set(path, (seconds.get(path) ?? 0) + took);
  if (details.type === 'suite') return;
  totals[skip === undefined ? outcome : 'skipped']++;
  tests.push([took, `${path}: ${name}`]);
}

async function runGroup({ files, concurrency }) {
  if (!files.length) return;
  const stream = run({ files: files.map((name) => join(FOLDER, name)), concurrency, timeout: FILE_MS });
  stream.on('test:pass', (event) => count('passed', event)).on('test:fail', (event) => count('failed', event));
  const report = stream.compose(new Spec());
  report.pipe(process.stdout, { end: false });
  await finished(report, { writable: false });
}

function summarise(took) {
  const line = ([time, name]) => `  ${time.toFixed(1).padStart(6)} s  ${name}`;
  const slowest = (timed) =>
    timed
      .toSorted(([a], [b]) => b - a)
      .slice(0, SLOWEST)
      .map(line);
  const { passed, failed, skipped } = totals;
  console.log(
    ['', 'Slowest tests:', ...slowest(tests), 'Slowest files:', ...slowest([...seconds].map(([name, time]) => [time, name]))].join('\n'),
  );
  console.log(`\n${passed} passed, ${failed} failed, ${skipped} skipped in ${took.toFixed(0)} s`);
}

// without a handler only the shared browser would exit
process.once('SIGTERM', () => process.exit(143));
const began = performance.now();
const folder = mkdtempSync(join(tmpdir(), 'tmpi-camera-'));
const servers = [];
/** Shares a browser with the test files by an environment variable. */
async function share(variable, launching) {
  servers.push(await launching);
  process.env[variable] = servers.at(-1).wsEndpoint();
}
try {
  if (browserFiles.length) await share(SHARED, launchShared());
  if (files.some(importersOf('room.mjs'))) await share(SHARED_CAMERA, launchSharedCamera(folder));
  for (const group of groups) await runGroup(group);
} finally {
  for (const server of servers) await server.close();
  rmSync(folder, { recursive: true, force: true });
}
summarise((performance.now() - began) / 1000);
process.exitCode = totals.failed ? 1 : 0;

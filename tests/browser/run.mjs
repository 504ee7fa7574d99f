// Runs the tests in the given files, or all: `node run.mjs [FILE…]`. Tests without a browser run first; the others share one Chromium.
import { readdirSync, readFileSync } from 'node:fs';
import { availableParallelism } from 'node:os';
import { join, relative, resolve } from 'node:path';
import { finished } from 'node:stream/promises';
import { run } from 'node:test';
import { spec as Spec } from 'node:test/reporters';
import { launchShared, SHARED } from './support/browser.mjs';

const FOLDER = import.meta.dirname;
/** Number of slowest tests to print. */
const SLOWEST = 10;
/** Time limit for a test file. */
const FILE_MS = 10 * 60_000;
/** Browser test files that run in parallel. On two cores, five files took 121 and 117 s one by one, 99 and 97 s in pairs (`TMPI_PAGES_AT_ONCE=1`, `2`). */
const BROWSER_CONCURRENCY = Number(process.env.TMPI_PAGES_AT_ONCE || Math.min(2, availableParallelism()));
/** Files that measure time, which run alone. */
const TIMED = /^live\/(?:faults|hidden-page|room|streams)\.|^element\/room/;

const browserUse = new Map();
/** Whether a module, or one that it imports, may start a browser. */
function startsBrowser(path) {
  if (path === join(FOLDER, 'support/browser.mjs')) return true;
  if (!browserUse.has(path)) {
    browserUse.set(path, false);
    const imported = [...readFileSync(path, 'utf8').matchAll(/ from '(\.[^']+\.mjs)'/g)].map(([, name]) => resolve(path, '..', name));
    browserUse.set(path, imported.some(startsBrowser));
  }
  return browserUse.get(path);
}

const all = readdirSync(FOLDER, { recursive: true }).filter((name) => name.endsWith('.test.mjs') && !name.startsWith('node_modules'));
const named = process.argv.slice(2).map((name) => relative(FOLDER, resolve(name)));
const files = (named.length ? named : all).toSorted();
const browserFiles = files.filter((name) => startsBrowser(join(FOLDER, name)));
const groups = [
  { files: files.filter((name) => !browserFiles.includes(name)), concurrency: availableParallelism() },
  { files: browserFiles.filter((name) => !TIMED.test(name)), concurrency: BROWSER_CONCURRENCY },
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
const server = browserFiles.length ? await launchShared() : null;
if (server) process.env[SHARED] = server.wsEndpoint();
try {
  for (const group of groups) await runGroup(group);
} finally {
  await server?.close();
}
summarise((performance.now() - began) / 1000);
process.exitCode = totals.failed ? 1 : 0;

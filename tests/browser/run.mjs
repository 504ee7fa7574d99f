// Runs the tests: `node run.mjs [FILE…]`, all files without one. Tests of scripts alone come first; those of pages share one Chromium.
import { readdirSync, readFileSync } from 'node:fs';
import { availableParallelism } from 'node:os';
import { join, relative, resolve } from 'node:path';
import { finished } from 'node:stream/promises';
import { run } from 'node:test';
import { spec as Spec } from 'node:test/reporters';
import { launchShared, SHARED } from './support/browser.mjs';

const FOLDER = import.meta.dirname;
/** How many of the slowest are told. */
const SLOWEST = 10;
/** Time after which a file is given up. */
const FILE_MS = 10 * 60_000;
/** How many files of pages run beside each other: drawing in software takes all processors for one. */
const PAGES_AT_ONCE = Number(process.env.TMPI_PAGES_AT_ONCE || 1);
/** Files whose tests are of what happens in time, and nothing else is to run beside them. */
const TIMED = /^(?:live|input)\/|^element\/room/;

const browses = new Map();
/** Whether a module, or one that it imports, may start a browser. */
function startsBrowser(path) {
  if (path === join(FOLDER, 'support/browser.mjs')) return true;
  if (!browses.has(path)) {
    browses.set(path, false);
    const imported = [...readFileSync(path, 'utf8').matchAll(/ from '(\.[^']+\.mjs)'/g)].map(([, name]) => resolve(path, '..', name));
    browses.set(path, imported.some(startsBrowser));
  }
  return browses.get(path);
}

const all = readdirSync(FOLDER, { recursive: true }).filter((name) => name.endsWith('.test.mjs') && !name.startsWith('node_modules'));
const named = process.argv.slice(2).map((name) => relative(FOLDER, resolve(name)));
const files = (named.length ? named : all).toSorted();
const pages = files.filter((name) => startsBrowser(join(FOLDER, name)));
const groups = [
  { files: files.filter((name) => !pages.includes(name)), concurrency: availableParallelism() },
  { files: pages.filter((name) => !TIMED.test(name)), concurrency: PAGES_AT_ONCE },
  { files: pages.filter((name) => TIMED.test(name)), concurrency: 1 },
];

const totals = { passed: 0, failed: 0, skipped: 0 };
const tests = [];
const seconds = new Map();

/** Counts a test that has ended, or adds a suite's time to its file's. */
function count(outcome, { name, nesting, details, file, skip }) {
  const took = details.duration_ms / 1000;
  const of = relative(FOLDER, file ?? FOLDER);
  if (nesting === 0) seconds.set(of, (seconds.get(of) ?? 0) + took);
  if (details.type === 'suite') return;
  totals[skip === undefined ? outcome : 'skipped']++;
  tests.push([took, `${of}: ${name}`]);
}

async function runGroup({ files, concurrency }) {
  if (!files.length) return;
  const stream = run({ files: files.map((name) => join(FOLDER, name)), concurrency, timeout: FILE_MS });
  stream.on('test:pass', (of) => count('passed', of)).on('test:fail', (of) => count('failed', of));
  const told = stream.compose(new Spec());
  told.pipe(process.stdout, { end: false });
  await finished(told, { writable: false });
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

// the shared browser alone would end
process.once('SIGTERM', () => process.exit(143));
const began = performance.now();
const server = pages.length ? await launchShared() : null;
if (server) process.env[SHARED] = server.wsEndpoint();
try {
  for (const group of groups) await runGroup(group);
} finally {
  await server?.close();
}
summarise((performance.now() - began) / 1000);
process.exitCode = totals.failed ? 1 : 0;

// The modules in static/, and their imports.
import { readdirSync, readFileSync } from 'node:fs';
import { posix } from 'node:path';

const STATIC = new URL('../../../static/', import.meta.url);

export const source = (name) => readFileSync(new URL(name, STATIC), 'utf8');

/** Names of all files in static/. */
export const files = () =>
  readdirSync(STATIC, { recursive: true, withFileTypes: true })
    .filter((f) => f.isFile())
    .map((f) => posix.relative(STATIC.pathname, posix.join(f.parentPath, f.name)));

/** Names of the modules that a module imports. */
export function imports(name) {
  return [...source(name).matchAll(/^(?:import|export|\})[^'\n]*'(\.[^']+)';/gm)].map(([, path]) =>
    // the server serves the element's entry beside static/
    path.startsWith('./static/') ? path.slice('./static/'.length) : posix.normalize(posix.join(posix.dirname(name), path)),
  );
}

/** A module and all modules that it imports, directly or not. */
export function graph(name, seen = new Set()) {
  if (seen.has(name)) return seen;
  seen.add(name);
  for (const next of imports(name)) graph(next, seen);
  return seen;
}

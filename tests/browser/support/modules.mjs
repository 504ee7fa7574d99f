// The modules of the browser code, and what each imports.
import { readdirSync, readFileSync } from 'node:fs';
import { posix } from 'node:path';

const STATIC = new URL('../../../static/', import.meta.url);

export const source = (name) => readFileSync(new URL(name, STATIC), 'utf8');

/** Names of all files below static/. */
export const files = () =>
  readdirSync(STATIC, { recursive: true, withFileTypes: true })
    .filter((f) => f.isFile())
    .map((f) => posix.relative(STATIC.pathname, posix.join(f.parentPath, f.name)));

/** What a module names in `import` statements, which begin a line and end it. */
export function imports(name) {
  return [...source(name).matchAll(/^(?:import|export|\})[^'\n]*'(\.[^']+)';/gm)].map(([, path]) =>
    // the element's entry is served beside static/
    path.startsWith('./static/') ? path.slice('./static/'.length) : posix.normalize(posix.join(posix.dirname(name), path)),
  );
}

/** A module and all that it needs, directly or not. */
export function graph(name, seen = new Set()) {
  if (seen.has(name)) return seen;
  seen.add(name);
  for (const next of imports(name)) graph(next, seen);
  return seen;
}

// Packs the element for npm: `cargo xtask npm`, or `node npm/pack.mjs [FOLDER]`. Prints the archive's path.

import { execFileSync } from 'node:child_process';
import { copyFileSync, cpSync, mkdirSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { extname, join, resolve } from 'node:path';
import { fileURLToPath } from 'node:url';

const ROOT = fileURLToPath(new URL('../', import.meta.url));
/** Folders of static/ that the element uses, and the kinds of files that a browser requests. */
const FOLDERS = ['decode', 'draw', 'element', 'i18n', 'input', 'live', 'view'];
const KINDS = new Set(['.js', '.wasm', '.wgsl']);
/** Publishing is only on the server's own page. */
const PUBLISHING = ['encoders.js', 'camera-frames.js', 'microphone.js', 'microphone-worklet.js', 'publisher.js'].map(
  (name) => `live/${name}`,
);
const OWN = ['README.md', 'tmpi-viewer.d.ts', 'rest-client.js', 'rest-client.d.ts', 'upload.html'];
const LICENCES = ['LICENSE-MIT', 'LICENSE-APACHE'];

/**
 * Puts the package together and packs it.
 * @param {string} folder output folder; its contents are removed
 * @returns {string} path of the archive
 */
export function pack(folder) {
  const stage = join(folder, 'package');
  rmSync(folder, { recursive: true, force: true });
  mkdirSync(stage, { recursive: true });
  for (const name of OWN) copyFileSync(join(ROOT, 'npm', name), join(stage, name));
  for (const name of LICENCES) copyFileSync(join(ROOT, name), join(stage, name));
  copyFileSync(join(ROOT, 'static/element/tmpi-viewer.js'), join(stage, 'tmpi-viewer.js'));
  for (const name of FOLDERS) {
    cpSync(join(ROOT, 'static', name), join(stage, 'static', name), {
      recursive: true,
      filter: (path) =>
        (extname(path) === '' || KINDS.has(extname(path))) &&
        ![...PUBLISHING, 'element/tmpi-viewer.js'].some((name) => path.endsWith(name)),
    });
  }
  const [, version] = readFileSync(join(ROOT, 'Cargo.toml'), 'utf8').match(/\[workspace\.package\]\s+version = "([^"]+)"/);
  const description = JSON.parse(readFileSync(join(ROOT, 'npm/package.json'), 'utf8'));
  writeFileSync(join(stage, 'package.json'), `${JSON.stringify({ ...description, version }, null, 2)}\n`);
  const told = execFileSync('npm', ['pack', '--json', '--pack-destination', folder], { cwd: stage, stdio: ['ignore', 'pipe', 'ignore'] });
  return join(folder, JSON.parse(told)[0].filename);
}

if (process.argv[1] && resolve(process.argv[1]) === fileURLToPath(import.meta.url)) {
  console.log(pack(resolve(process.argv[2] ?? join(ROOT, 'target/npm'))));
}

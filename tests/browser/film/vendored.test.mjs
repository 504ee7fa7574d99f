// Vendored code equals the published packages.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { dirname, join } from 'node:path';
import { describe, test } from 'node:test';
import { source } from '../support/import-graph.mjs';

const require = createRequire(import.meta.url);
const pinned = JSON.parse(readFileSync(new URL('../package.json', import.meta.url), 'utf8')).devDependencies;
const README = source('vendor/README.md');

/** Folder of a package, independent of its exports. */
function folder(name) {
  for (let at = dirname(require.resolve(name)); ; at = dirname(at)) {
    try {
      if (JSON.parse(readFileSync(join(at, 'package.json'), 'utf8')).name === name) return at;
    } catch {
      // no package.json here: continue in the parent folder
    }
  }
}

describe('vendored code', () => {
  for (const [file, name, path] of [
    ['mp4-muxer.mjs', 'mp4-muxer', 'build/mp4-muxer.mjs'],
    ['webm-muxer.mjs', 'webm-muxer', 'build/webm-muxer.mjs'],
    ['gifenc.mjs', 'gifenc', 'dist/gifenc.esm.js'],
  ]) {
    test(`${file} equals the package’s file and has its licence`, () => {
      assert.equal(source(`vendor/${file}`), readFileSync(join(folder(name), path), 'utf8'));
      assert.match(source(`vendor/${name}.LICENSE.txt`), /Permission is hereby granted, free of charge/);
      assert.ok(README.includes(`\`${file}\``) && README.includes(`) ${pinned[name]} |`), 'the README lists file and version');
    });
  }
});

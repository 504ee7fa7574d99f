// Pages and workers list all modules that they need, so that no module waits for another to load.
import assert from 'node:assert/strict';
import { describe, test } from 'node:test';
import { files, graph, imports, source } from '../support/import-graph.mjs';

const sorted = (names) => [...names].toSorted();

describe('modules', () => {
  for (const page of ['upload', 'view', 'demo', 'embed', 'watch', 'publish']) {
    test(`the ${page} page preloads all modules of its script`, () => {
      const links = [...source(`app/${page}-page.html`).matchAll(/<link rel="modulepreload" href="\/static\/([^"]+)" \/>/g)].map(
        ([, name]) => name,
      );
      const scripts = [`app/${page}-page.js`];
      assert.ok(source(`app/${page}-page.html`).includes(`src="/static/${scripts[0]}"`));
      if (source(`app/${page}-page.html`).includes('src="/tmpi-viewer.js"')) scripts.push('element/tmpi-viewer.js');
      const needed = new Set(scripts.flatMap((script) => [...graph(script)]));
      assert.deepEqual(links, sorted([...needed].filter((name) => !scripts.includes(name))));
    });
  }

  for (const worker of ['decode/worker.js', 'live/worker.js']) {
    test(`${worker} imports all modules directly`, () => {
      const all = graph(worker);
      all.delete(worker);
      assert.deepEqual(sorted(imports(worker)), sorted(all));
    });
  }

  test('the element preloads the viewer, and rooms their extra modules', () => {
    const listed = (name) => {
      const [, list] = source('element/modules.js').match(new RegExp(`^export const ${name} = \\[([^\\]]*)\\];`, 'm'));
      return [...list.matchAll(/'([^']+)'/g)].map(([, module]) => module);
    };
    const photos = new Set([...graph('view/viewer.js'), ...graph('element/photo-addresses.js')]);
    assert.deepEqual(listed('MODULES'), sorted(photos));
    assert.deepEqual(listed('ROOM_MODULES'), sorted([...graph('element/room.js')].filter((name) => !photos.has(name))));
  });

  // decode/scene.js has only types
  test('every module is used', () => {
    const roots = [
      'app/upload-page.js',
      'app/share-worker.js',
      'app/view-page.js',
      // loaded on demand
      'app/touch-up.js',
      'app/demo-page.js',
      'app/embed-page.js',
      'app/watch-page.js',
      'app/publish-page.js',
      'app/missing-page.js',
      'element/tmpi-viewer.js',
      'element/photo-addresses.js',
      'element/room.js',
      'view/viewer.js',
      'decode/worker.js',
      'decode/unpack.js',
      'live/worker.js',
      'live/microphone-worklet.js',
      // loaded on demand
      'app/access-dialog.js',
      'app/owner-dialog.js',
      'app/embed-dialog.js',
      'app/film-dialog.js',
      'app/link-dialog.js',
      'film/gif.js',
    ];
    const needed = new Set(roots.flatMap((root) => [...graph(root)]));
    assert.deepEqual(
      files().filter((name) => name.endsWith('.js') && !needed.has(name) && name !== 'decode/scene.js'),
      [],
    );
  });
});

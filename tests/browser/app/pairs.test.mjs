// Photos and depth maps told apart by their names; where depth comes from, in words.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';
import { pairs } from '../../../static/app/pairs.js';

// the module looks at the browser's language when it is loaded
Object.defineProperty(globalThis, 'navigator', { value: { language: 'en' }, configurable: true });
const { depthSource, networkName } = await import('../../../static/app/depth-source.js');

/** Pairs of files by their names; what stands before a slash is their folder. */
const named = (...names) => {
  const folders = new Map(names.map((name) => [/.*\/|/.exec(name)[0], {}]));
  const files = names.map((name) => ({ file: new File(['x'], name.replace(/.*\//, '')), folder: folders.get(/.*\/|/.exec(name)[0]) }));
  return pairs(files).map(({ file, depth }) => [file.name, depth?.name ?? null]);
};

test('a map goes with its photo, in any order and with any extension', () => {
  assert.deepEqual(named('a_depth.png', 'a.jpg', 'b.jpg'), [
    ['a.jpg', 'a_depth.png'],
    ['b.jpg', null],
  ]);
  for (const map of ['A-Depth.jpg', 'a.depthmap.webp', 'a_depth_map.png', 'a disparity.png', 'a_disp.png'])
    assert.deepEqual(named('a.jpg', map), [['a.jpg', map]], map);
});

test('a name that only looks like a map’s is a photo', () => {
  assert.deepEqual(named('depth.png', 'in-depth.jpg', 'b.jpg'), [
    ['depth.png', null],
    ['in-depth.jpg', null],
    ['b.jpg', null],
  ]);
  assert.deepEqual(named('_depth.png'), [['_depth.png', null]]);
  // the second map of a photo is no photo
  assert.deepEqual(named('a.jpg', 'a_depth.png', 'a-depth.png'), [['a.jpg', 'a_depth.png']]);
});

test('a map goes with a photo of its own folder', async () => {
  const text = (name, content) => ({ file: new File([content], name) });
  const [one, two] = [{}, {}];
  const both = pairs([
    { ...text('photo.jpg', '1'), folder: one },
    { ...text('photo_depth.jpg', '1d'), folder: one },
    { ...text('photo.jpg', '2'), folder: two },
    { ...text('photo_depth.jpg', '2d'), folder: two },
  ]);
  const contents = await Promise.all(both.map(async ({ file, depth }) => [await file.text(), await depth?.text()]));
  assert.deepEqual(contents, [
    ['1', '1d'],
    ['2', '2d'],
  ]);
  // one that has none there is a photo
  assert.deepEqual(named('x/a.jpg', 'y/a_depth.png', 'a.jpg'), [
    ['a.jpg', null],
    ['a_depth.png', null],
    ['a.jpg', null],
  ]);
});

test('of photos that are called alike the first has the map', () => {
  assert.deepEqual(named('a.png', 'a.jpg', 'a_depth.png'), [
    ['a.png', 'a_depth.png'],
    ['a.jpg', null],
  ]);
  assert.deepEqual(named('a_depth.png', 'a.jpg', 'A.webp'), [
    ['a.jpg', 'a_depth.png'],
    ['A.webp', null],
  ]);
});

test('every network that the program ranks has a name for people', () => {
  const registry = readFileSync(new URL('../../../crates/pipeline/src/networks/models/registry.rs', import.meta.url), 'utf8');
  const ranks = /const RANKS[^=]*= \[([^\]]*)\]/
    .exec(registry)[1]
    .split('"')
    .filter((_, i) => i % 2);
  assert.ok(ranks.length > 10);
  for (const rank of ranks) assert.notEqual(networkName(rank), rank);
});

test('what made the depth is told in words', () => {
  const report = (depth_model, input = {}) => ({ depth_model, input, stages: [{ name: 'depth', ms: 31 }] });
  assert.equal(depthSource(report('tmpi')), 'Depth: estimated by the built-in network in 0.03 s.');
  assert.equal(depthSource(report('depth-anything-v2-small-fp16')), 'Depth: estimated by Depth Anything V2 Small in 0.03 s.');
  assert.equal(depthSource(report('other-net')), 'Depth: estimated by other-net in 0.03 s.');
  assert.equal(depthSource(report('carried', { depth: { stretched: false } })), 'Depth: from the photo itself.');
  assert.ok(depthSource(report('given', { depth: { stretched: true } })).includes('stretched'));
  assert.equal(depthSource({}), '');
  assert.ok(depthSource(report('tmpi', { depth_problem: 'it is torn' })).endsWith('it is torn'));
});

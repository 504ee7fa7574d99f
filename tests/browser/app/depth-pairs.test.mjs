// Pairs of photos and depth maps by file name, and the text about the depth's source.
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';
import { pairs } from '../../../static/app/depth-pairs.js';

// the module reads the browser's language when it loads
Object.defineProperty(globalThis, 'navigator', { value: { language: 'en' }, configurable: true });
const { depthSummary, networkName } = await import('../../../static/app/depth-summary.js');

/** Names of the pairs that files with these names form; the part before a slash is the folder. */
const pairNames = (...names) => {
  const folders = new Map(names.map((name) => [/.*\/|/.exec(name)[0], {}]));
  const files = names.map((name) => ({ file: new File(['x'], name.replace(/.*\//, '')), folder: folders.get(/.*\/|/.exec(name)[0]) }));
  return pairs(files).map(({ file, depth }) => [file.name, depth?.name ?? null]);
};

test('pairs maps with photos in any order and format', () => {
  assert.deepEqual(pairNames('a_depth.png', 'a.jpg', 'b.jpg'), [
    ['a.jpg', 'a_depth.png'],
    ['b.jpg', null],
  ]);
  for (const map of ['A-Depth.jpg', 'a.depthmap.webp', 'a_depth_map.png', 'a disparity.png', 'a_disp.png'])
    assert.deepEqual(pairNames('a.jpg', map), [['a.jpg', map]], map);
});

test('treats names that only resemble a map as photos', () => {
  assert.deepEqual(pairNames('depth.png', 'in-depth.jpg', 'b.jpg'), [
    ['depth.png', null],
    ['in-depth.jpg', null],
    ['b.jpg', null],
  ]);
  assert.deepEqual(pairNames('_depth.png'), [['_depth.png', null]]);
  // a second map of the same photo is ignored
  assert.deepEqual(pairNames('a.jpg', 'a_depth.png', 'a-depth.png'), [['a.jpg', 'a_depth.png']]);
});

test('pairs only within a folder', async () => {
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
  // a map without a photo in its folder is a photo
  assert.deepEqual(pairNames('x/a.jpg', 'y/a_depth.png', 'a.jpg'), [
    ['a.jpg', null],
    ['a_depth.png', null],
    ['a.jpg', null],
  ]);
});

test('gives the map to the first of equally named photos', () => {
  assert.deepEqual(pairNames('a.png', 'a.jpg', 'a_depth.png'), [
    ['a.png', 'a_depth.png'],
    ['a.jpg', null],
  ]);
  assert.deepEqual(pairNames('a_depth.png', 'a.jpg', 'A.webp'), [
    ['a.jpg', 'a_depth.png'],
    ['A.webp', null],
  ]);
});

test('every ranked network has a readable name', () => {
  const registry = readFileSync(new URL('../../../crates/pipeline/src/networks/models/registry.rs', import.meta.url), 'utf8');
  const ranks = /const RANKS[^=]*= \[([^\]]*)\]/
    .exec(registry)[1]
    .split('"')
    .filter((_, i) => i % 2);
  assert.ok(ranks.length > 10);
  for (const rank of ranks) assert.notEqual(networkName(rank), rank);
});

test('depthSummary describes where the depth comes from', () => {
  const report = (depth_model, input = {}) => ({ depth_model, input, stages: [{ name: 'depth', ms: 31 }] });
  assert.equal(depthSummary(report('tmpi')), 'Depth: estimated by the built-in network in 0.03 s.');
  assert.equal(depthSummary(report('depth-anything-v2-small-fp16')), 'Depth: estimated by Depth Anything V2 Small in 0.03 s.');
  assert.equal(depthSummary(report('other-net')), 'Depth: estimated by other-net in 0.03 s.');
  assert.equal(depthSummary(report('embedded', { depth: { stretched: false } })), 'Depth: from the photo itself.');
  assert.ok(depthSummary(report('given', { depth: { stretched: true } })).includes('stretched'));
  assert.ok(depthSummary(report('tmpi', { depth_problem: 'it is torn' })).endsWith('it is torn'));
});
